"""The world: environments, and the hidden processes that disturb them."""
