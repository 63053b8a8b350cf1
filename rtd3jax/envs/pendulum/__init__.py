"""gymnax's pendulum, whose observation is disturbed."""
