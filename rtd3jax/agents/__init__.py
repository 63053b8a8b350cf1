"""One learner, pure functions over one lane."""
