"""The files that a calibration leaves, and reading them back."""
