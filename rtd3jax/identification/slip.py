"""What the fits of slip have in common."""

from collections.abc import Sequence

import numpy as np

from rtd3jax.errors import UserError

TOLERANCE = 1e-5
"""Slip this near to a bound was clipped: a quotient of float32 speeds is not more exact."""


def bounded_slip(
    kind: str, parts: Sequence[np.ndarray], max_slip: float | None
) -> tuple[list[np.ndarray], float, bool]:
    """The log within its bounds, the upper bound, and whether slip was clipped there.

    Raises:
        UserError: for what is no slip.
    """
    low, top = min(part.min() for part in parts), max(part.max() for part in parts)
    if low < -TOLERANCE or top > 1.0 + TOLERANCE:
        raise UserError(
            f"{kind} is of slip, a share of the speed from 0 to 1, and the log goes from {low:.3g} "
            f'to {top:.3g}; fit "ornstein-uhlenbeck" to an offset, or clip the log'
        )
    if max_slip is not None and top > max_slip + TOLERANCE:
        raise UserError(f"max_slip={max_slip} is less than the largest slip in the log, {top:.4g}")
    bound = float(min(top, 1.0)) if max_slip is None else float(max_slip)
    reached = sum(int(np.sum(part >= bound - TOLERANCE)) for part in parts)
    # A largest value that occurs once is just the largest.
    clipped = reached > (1 if max_slip is None else 0)
    return [np.clip(part, 0.0, bound) for part in parts], bound, clipped
