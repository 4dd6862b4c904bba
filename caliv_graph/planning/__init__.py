"""Before driving: what a planned drive will tell, and which drive would tell enough."""

from caliv_graph.planning.predict import Assumptions, Prediction, predict

__all__ = ["Assumptions", "Prediction", "predict"]
