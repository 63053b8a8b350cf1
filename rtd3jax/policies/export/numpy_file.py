"""The numpy format: a Python file, `rtd3jax.policies.export.player` with the weights in it."""

import base64
import importlib.resources

from rtd3jax.policies.export.model import Model, check_portable

_HEADER = "HEADER: dict[str, Any] = {}\n"
_WEIGHTS = 'WEIGHTS = ""\n'


def numpy_bytes(model: Model) -> bytes:
    """The source of a module with a class ``Player``: ``reset()``, ``step(observation)``.

    Raises:
        UserError: when the format does not support the model's memory or encoder.
    """
    check_portable(model, "numpy")
    shapes = {name: list(array.shape) for name, array in model.arrays.items()}
    raw = b"".join(array.astype("<f4").tobytes() for array in model.arrays.values())
    metadata = repr({**model.header(), "arrays": shapes})
    text = base64.encodebytes(raw).decode()
    source = (
        importlib.resources.files("rtd3jax.policies.export")
        .joinpath("player.py")
        .read_text("utf-8")
    )
    assert source.count(_HEADER) == 1 and source.count(_WEIGHTS) == 1
    source = source.replace(_HEADER, f"HEADER: dict[str, Any] = {metadata}\n")
    # The weights come last, so that no text in the header can be mistaken for their mark.
    head, tail = source.split(_WEIGHTS)
    return f'{head}WEIGHTS = """\n{text}"""\n{tail}'.encode()
