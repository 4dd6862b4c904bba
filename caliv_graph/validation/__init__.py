"""Validation of a calibration: alignment of the LiDARs on what stands around a drive."""

from caliv_graph.validation.findings import Validation
from caliv_graph.validation.validate import validate

__all__ = ["Validation", "validate"]
