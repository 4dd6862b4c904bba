"""Validation of a calibration: alignment on structure that the solve did not use."""

from caliv_graph.validation.findings import Validation
from caliv_graph.validation.validate import validate

__all__ = ["Validation", "validate"]
