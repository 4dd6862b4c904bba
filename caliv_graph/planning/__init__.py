"""Before driving: the covariance that a planned drive allows, and a drive that is good enough."""

from caliv_graph.planning.assumptions import Assumptions
from caliv_graph.planning.predict import Prediction, predict

__all__ = ["Assumptions", "Prediction", "predict"]
