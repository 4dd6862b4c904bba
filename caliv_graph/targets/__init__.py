"""Finding the target's points in the clouds."""

from caliv_graph.targets.extract import extract_targets

__all__ = ["extract_targets"]
