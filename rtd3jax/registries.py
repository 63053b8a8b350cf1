"""Names that users may add to: agents, memories and learners, each in one table."""

from collections.abc import Iterator
from typing import Any, Generic, TypeVar

from rtd3jax.errors import UserError, nearest

Entry = TypeVar("Entry")


class Registry(Generic[Entry]):
    """Entries by name, in the order in which they came.

    Args:
        kind: what an entry is called in messages, such as ``memory``.
        remedy: the call that adds one, for messages.
    """

    def __init__(self, kind: str, remedy: str) -> None:
        self._kind = kind
        self._remedy = remedy
        self._entries: dict[str, Entry] = {}

    def register(self, name: str, entry: Entry, *, replace: bool = False) -> None:
        """Add ``entry`` under ``name``.

        Raises:
            UserError: when the name is taken and ``replace`` is false, or is not a word.
        """
        if not isinstance(name, str) or not name or any(c.isspace() or c in "/:," for c in name):
            raise UserError(f"{self._kind} {name!r} is no name: use letters, digits and hyphens")
        if name in self._entries and not replace:
            raise UserError(
                f"{self._kind} {name!r} is there already; choose another name, or say replace=True"
            )
        self._entries[name] = entry

    def check(self, name: object) -> None:
        """Raise UserError unless there is an entry of this name."""
        if not isinstance(name, str) or name not in self._entries:
            raise UserError(
                f"{self._kind} {name!r} is unknown{nearest(str(name), tuple(self._entries))}; "
                f"there are {', '.join(self._entries)}; {self._remedy} adds one"
            )

    def __getitem__(self, name: str) -> Entry:
        self.check(name)
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


AGENTS: Registry[Any] = Registry("algorithm", "rtd.register_agent(name, variant)")
"""Filled by `rtd3jax.agents.variants`."""

MEMORIES: Registry[Any] = Registry("memory", "rtd.register_memory(name, module)")
"""Filled by `rtd3jax.agents.memory`."""

LEARNERS: Registry[Any] = Registry("learner", "rtd.register_learner(name, make)")
"""Filled by `rtd3jax.agents.learners`."""
