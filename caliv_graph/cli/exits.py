"""Exit codes (SPEC 5)."""

from caliv_graph.exits import DEFECT, DONE, INCONSISTENT, INTERRUPTED, UNMET, USAGE

__all__ = ["DEFECT", "DONE", "INCONSISTENT", "INTERRUPTED", "UNMET", "USAGE"]
