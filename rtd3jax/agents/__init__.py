"""Agents: networks, memories, learners and replay, as pure functions of one lane's arrays."""
