"""Covariance, observability and consistency: on matrices, without the graph."""
