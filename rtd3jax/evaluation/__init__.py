"""Evaluation of policies in whole episodes, and the best possible return."""
