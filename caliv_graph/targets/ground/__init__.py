"""The ground in each scan."""
