"""The page of a run directory: one HTML file that needs no network."""
