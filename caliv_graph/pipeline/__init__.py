"""From recordings to a calibration; what a drive shows before it is solved."""

from caliv_graph.pipeline.inspection import Look, look
from caliv_graph.pipeline.preparation import Prepared, completed_motions, prepare
from caliv_graph.pipeline.run import calibrate, structure_evidence, with_prior, without_anything

__all__ = [
    "Look",
    "Prepared",
    "calibrate",
    "completed_motions",
    "look",
    "prepare",
    "structure_evidence",
    "with_prior",
    "without_anything",
]
