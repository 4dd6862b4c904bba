"""Constants of statistics that several rooms use."""

MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute value."""
