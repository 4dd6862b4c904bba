"""The calibration graph and its estimator."""
