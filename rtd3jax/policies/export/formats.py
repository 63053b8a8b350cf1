"""The export formats by name."""

from collections.abc import Callable

from rtd3jax.errors import UserError, nearest
from rtd3jax.policies.export.model import Model
from rtd3jax.policies.export.numpy_file import numpy_bytes
from rtd3jax.policies.export.onnx_file import onnx_bytes
from rtd3jax.policies.export.stablehlo_file import stablehlo_bytes

FORMATS: dict[str, tuple[str, Callable[[Model], bytes]]] = {
    "onnx": (".onnx", onnx_bytes),
    "stablehlo": (".stablehlo", stablehlo_bytes),
    "numpy": (".py", numpy_bytes),
}
"""For each format, the usual suffix and the function that returns the content of a file."""


def writer_of(format: str, path: str) -> Callable[[Model], bytes]:
    """The function that returns the content of a file of ``format`` at ``path``.

    Raises:
        UserError: for an unknown format, or a numpy player that Python could not import.
    """
    if format not in FORMATS:
        raise UserError(
            f"format {format!r} is unknown{nearest(str(format), FORMATS)}; "
            f"the formats are {', '.join(FORMATS)}"
        )
    if format == "numpy" and not path.endswith(".py"):
        raise UserError(f"the numpy format is a Python file: {path} must end in .py")
    return FORMATS[format][1]
