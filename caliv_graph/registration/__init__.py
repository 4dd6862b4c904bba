"""Joint registration of the target's clouds."""
