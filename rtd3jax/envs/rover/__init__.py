"""The rover whose wheels slip."""
