"""Covariance, observability and consistency: numbers from matrices; no graph, no sentences."""
