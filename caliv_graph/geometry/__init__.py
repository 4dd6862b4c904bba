"""Poses, their tangents and their covariances."""
