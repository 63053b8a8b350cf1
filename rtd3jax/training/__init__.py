"""Training: the loop of one lane, and the distribution of lanes over cores and devices."""
