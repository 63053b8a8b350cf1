"""Hand-designed controllers as policies: any function, PID and LQR.

A controller is evaluated and shown in tables and figures like a trained policy. Gains are arrays of
a pytree, so controllers with different gains share a compiled program. A function is part of its
program, so each function has its own program.
"""

from rtd3jax.envs.controllers.function import FunctionPolicy, function_policy
from rtd3jax.envs.controllers.lqr import LinearPolicy, lqr_policy, riccati_gain
from rtd3jax.envs.controllers.pid import PIDPolicy, PIDState, pid_policy

__all__ = [
    "FunctionPolicy",
    "LinearPolicy",
    "PIDPolicy",
    "PIDState",
    "function_policy",
    "lqr_policy",
    "pid_policy",
    "riccati_gain",
]
