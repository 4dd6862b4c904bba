"""The target's points in each scan."""
