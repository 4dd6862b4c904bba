"""Finding the target's points in the clouds."""

from caliv_graph.targets.cloud.extract import extract_targets

__all__ = ["extract_targets"]
