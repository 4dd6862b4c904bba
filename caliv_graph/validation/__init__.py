"""Is a calibration right? Alignment on structure that the solve did not use."""

from caliv_graph.validation.validate import Validation, validate

__all__ = ["Validation", "validate"]
