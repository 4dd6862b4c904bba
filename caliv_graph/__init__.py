"""Factor-graph calibration of LiDARs to each other and to the vehicle."""

__version__ = "0.1.0"
