"""Tables of names to which users may add: agents, memories and learners."""

from collections.abc import Iterator
from typing import Any, Generic, TypeVar

from rtd3jax.errors import UserError, nearest
from rtd3jax.system.program_cache import forget_programs

Entry = TypeVar("Entry")


class Registry(Generic[Entry]):
    """Entries by name, in the order of their registration.

    Args:
        kind: what messages call an entry, such as ``memory``.
        remedy: the call that adds an entry, for messages.
    """

    def __init__(self, kind: str, remedy: str) -> None:
        self._kind = kind
        self._remedy = remedy
        self._entries: dict[str, Entry] = {}

    def register(self, name: str, entry: Entry, *, replace: bool = False) -> None:
        """Add ``entry`` under ``name``.

        Raises:
            UserError: when ``name`` is empty, contains a space or one of ``/:,``, or is taken while
                ``replace`` is false.
        """
        if not isinstance(name, str) or not name or any(c.isspace() or c in "/:," for c in name):
            raise UserError(
                f"{self._kind} {name!r} is not a valid name: use letters, digits and hyphens"
            )
        if name in self._entries and not replace:
            raise UserError(
                f"{self._kind} {name!r} is already registered; choose another name, "
                "or pass replace=True"
            )
        replaced = self._entries.get(name, entry) is not entry
        self._entries[name] = entry
        if replaced:  # compiled programs are found by names, and may contain the former entry
            forget_programs()

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
"""The definition of each agent; `rtd3jax.agents.variants` fills this table."""

MEMORIES: Registry[Any] = Registry("memory", "rtd.register_memory(name, module)")
"""The module of each memory; `rtd3jax.agents.memory` fills this table."""

LEARNERS: Registry[Any] = Registry("learner", "rtd.register_learner(name, make)")
"""A function that makes each learner; `rtd3jax.agents.learners` fills this table."""
