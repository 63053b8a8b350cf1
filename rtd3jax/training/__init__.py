"""From one lane to many."""
