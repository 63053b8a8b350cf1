"""Memories: the recurrent cells of the agents."""

from rtd3jax.agents.memory.base import Memory, check_memory, register_memory
from rtd3jax.agents.memory.gru import GRU
from rtd3jax.agents.memory.lstm import LSTM
from rtd3jax.agents.memory.min_gru import MinGRU

__all__ = ["GRU", "LSTM", "Memory", "MinGRU", "check_memory", "register_memory"]

for _name, _module in (("lstm", LSTM), ("gru", GRU), ("min-gru", MinGRU)):
    register_memory(_name, _module)
