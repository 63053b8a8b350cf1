"""What is known of an environment beside its dynamics."""

from typing import NamedTuple


class Ceiling(NamedTuple):
    """A mean return, its standard error, and what it is.

    Attributes:
        mean: best possible mean return, or a bound from above.
        standard_error: of ``mean``; of an integral, which has no luck in it, the grid's error.
        kind: ``exact`` (the best policy's own return), or ``upper bound``.
    """

    mean: float
    standard_error: float
    kind: str
