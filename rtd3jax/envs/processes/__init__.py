"""Hidden processes that disturb an observation, an action or a reward."""
