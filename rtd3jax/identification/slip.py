"""Code that the fits of slip share."""

from collections.abc import Sequence

import numpy as np

from rtd3jax.errors import UserError

TOLERANCE = 1e-5
"""Slip within this distance of a bound counts as clipped, due to the rounding of float32."""


def bounded_slip(
    kind: str, parts: Sequence[np.ndarray], max_slip: float | None
) -> tuple[list[np.ndarray], float, bool]:
    """The clipped log, the upper bound, and whether slip was clipped there.

    Raises:
        UserError: if the values cannot be slip.
    """
    low, top = min(part.min() for part in parts), max(part.max() for part in parts)
    if low < -TOLERANCE or top > 1.0 + TOLERANCE:
        raise UserError(
            f"{kind} needs slip, a fraction of the speed from 0 to 1, but the log goes from "
            f'{low:.3g} to {top:.3g}; fit "ornstein-uhlenbeck" to an offset, or clip the log'
        )
    if max_slip is not None and top > max_slip + TOLERANCE:
        raise UserError(f"max_slip={max_slip} is less than the largest slip in the log, {top:.4g}")
    bound = float(min(top, 1.0)) if max_slip is None else float(max_slip)
    reached = sum(int(np.sum(part >= bound - TOLERANCE)) for part in parts)
    # A largest value that occurs only once was not clipped.
    clipped = reached > (1 if max_slip is None else 0)
    return [np.clip(part, 0.0, bound) for part in parts], bound, clipped
