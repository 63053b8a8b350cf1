"""Texts in which files state environments, and by which they distinguish them."""

import collections
import dataclasses
import functools
import hashlib
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.identity import ValueIdentity

_WORDS = (str, bool, int, float)

_DEEPEST = 30
"""Levels of nested objects that a text contains; deeper ones are an ellipsis."""

_LONGEST = 10_000
"""Most characters of the text of one object; a longer one is replaced by its digest."""

_MOST_ELEMENTS = 16
"""Most elements of an array that a text contains; those of a longer one are replaced by a digest"""


def in_words(thing: object, *, numbers: bool = True) -> str:
    """A text that distinguishes environments, their options, or parameters.

    It contains types, the attributes of objects, numbers, and digests of the code of functions with
    their defaults and closures. The text is the same in every process of the same Python version:
    it has no addresses. Objects of compiled classes are only named by their type.

    Args:
        thing: an environment, parameters, a function, or an option of them.
        numbers: whether to state arrays, and the numbers of dataclasses. The numbers of parameters
            are leaves of a pytree, which an identity states beside this text.
    """
    return _Words().of(thing, numbers)


class _Words:
    """Writes one text.

    Each object is written once, so that objects that refer to each other cannot take for ever.
    """

    def __init__(self) -> None:
        # The objects are kept, so that no other object gets their ids.
        self._known: dict[tuple[int, bool], tuple[object, str]] = {}

    def of(self, thing: object, numbers: bool, depth: int = 0) -> str:
        if thing is None or isinstance(thing, _WORDS):
            return repr(thing)
        key = id(thing), numbers
        if key not in self._known:
            self._known[key] = thing, "..."  # what a part of the object sees that refers to it
            text = self._text(thing, numbers, depth + 1) if depth < _DEEPEST else "..."
            if len(text) > _LONGEST:
                text = f"{type(thing).__qualname__} of sha256 {_digest(text)}"
            self._known[key] = thing, text
        return self._known[key][1]

    def _text(self, thing: Any, numbers: bool, depth: int) -> str:
        def of(part: object) -> str:
            return self.of(part, numbers, depth)

        name = type(thing).__qualname__
        if isinstance(thing, ValueIdentity):
            return f"{name}({', '.join(map(of, thing.identity()))})"
        if isinstance(thing, tuple | list | collections.deque):
            return f"({', '.join(map(of, thing))})"
        if isinstance(thing, Mapping):
            pairs = ((k if isinstance(k, str) else of(k), of(v)) for k, v in thing.items())
            return f"({', '.join(f'{key}={value}' for key, value in pairs)})"
        if isinstance(thing, set | frozenset):
            return f"{{{', '.join(sorted(map(of, thing)))}}}"
        if isinstance(thing, np.ndarray | jax.Array):
            return self._array(thing, depth) if numbers else "*"
        if isinstance(thing, np.generic):
            return repr(thing) if numbers else f"{name}()"
        if isinstance(thing, bytes | complex | range | slice):
            return repr(thing)
        if isinstance(thing, types.ModuleType):
            return f"module {thing.__name__}"
        if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
            return f"{name}({', '.join(self._fields(thing, numbers, depth))})"
        if callable(thing) and (text := self._function(thing, of)):
            return text
        return f"{name}({', '.join(self._attributes(thing, of))})"

    def _array(self, array: Any, depth: int) -> str:
        if isinstance(array, jax.core.Tracer):
            return "*"
        if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
            array = jax.random.key_data(array)
        values = np.asarray(array)
        kind = f"{values.dtype}{list(values.shape)}"
        if values.dtype.hasobject:
            return f"{kind} {self.of(values.tolist(), True, depth)}"
        if values.size <= _MOST_ELEMENTS:
            return f"{kind} {values.tolist()}"
        return f"{kind} of sha256 {_digest(np.ascontiguousarray(values).tobytes())}"

    def _fields(self, thing: Any, numbers: bool, depth: int) -> Iterator[str]:
        """The fields of a dataclass; without ``numbers``, only static fields may be numbers."""
        for field in dataclasses.fields(thing):
            value = getattr(thing, field.name, None)
            static = field.metadata.get("pytree_node") is False or field.metadata.get("static")
            whole = numbers or bool(static)
            if whole or not isinstance(value, int | float | np.ndarray | jax.Array):
                yield f"{field.name}={self.of(value, whole, depth)}"

    def _function(self, thing: Any, of: Callable[[object], str]) -> str:
        """A function or a class in words; "" for an object that can be called."""
        if isinstance(thing, functools.partial):
            named = (f"{key}={of(value)}" for key, value in sorted(thing.keywords.items()))
            return f"partial({', '.join((*map(of, (thing.func, *thing.args)), *named))})"
        if isinstance(thing, types.MethodType):
            return f"{of(thing.__func__)} of {of(thing.__self__)}"
        if isinstance(thing, types.FunctionType):
            cells = [_content(cell) for cell in thing.__closure__ or ()]
            given = _code(thing.__code__), thing.__defaults__, thing.__kwdefaults__, cells
            return f"{thing.__module__}.{thing.__qualname__} {_digest(of(given))[:16]}"
        if not isinstance(thing, type) and callable(inner := getattr(thing, "__wrapped__", None)):
            return of(inner)  # a function that JAX compiles, for example
        return str(getattr(thing, "__qualname__", ""))

    def _attributes(self, thing: Any, of: Callable[[object], str]) -> Iterator[str]:
        """What an object consists of, in words: what `pickle` would store of it.

        So a class can leave something out by ``__getstate__``.
        """
        kind = type(thing)
        if not hasattr(thing, "__dict__") and not any("__slots__" in vars(k) for k in kind.__mro__):
            return
        if kind.__module__.partition(".")[0] == "gymnax":
            # All options of gymnax's environments are words; the rest follows from them.
            own = {k: v for k, v in vars(thing).items() if isinstance(v, _WORDS)}
            yield from (f"{key}={own[key]!r}" for key in sorted(own))
            return
        try:
            made: Any = thing.__reduce_ex__(2)
        except Exception:  # it cannot be stored, such as a lock
            return
        if isinstance(made, str):
            yield made
            return
        function, arguments = made[:2]
        state, items = made[2] if len(made) > 2 else None, made[3:]
        new = function.__name__ == "__newobj__"  # of pickle: its first argument is the class
        yield from map(of, arguments[1:] if new else arguments)
        parts = state if isinstance(state, tuple) else (state,)
        if all(part is None or isinstance(part, dict) for part in parts):  # of slots, too
            own = {str(key): value for part in parts if part for key, value in part.items()}
            for key in sorted(own):
                # A cached property is there or not, and follows from the rest.
                if not isinstance(getattr(kind, key, None), functools.cached_property):
                    yield f"{key}={of(own[key])}"
        else:
            yield of(state)
        yield from (of(list(part)) for part in items if part is not None)


def _content(cell: types.CellType) -> object:
    """The value of a variable of a closure; None if it has none yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _code(code: types.CodeType) -> tuple:
    """What a function does: its instructions, and the names and constants that they use."""
    constants = (_code(c) if isinstance(c, types.CodeType) else c for c in code.co_consts)
    return code.co_code, code.co_names, *constants


def _digest(content: str | bytes) -> str:
    content = content.encode(errors="surrogatepass") if isinstance(content, str) else content
    return hashlib.sha256(content).hexdigest()
