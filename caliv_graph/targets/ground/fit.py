"""The ground under a target, by RANSAC among near-horizontal planes."""

from __future__ import annotations

import math

import numpy as np

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array

TRIALS = 100
"""Triples tried. With half the points on the ground, 1 in 8 hits; all 100 miss with probability
2e-6."""

MAX_TILT_RAD = math.radians(15.0)
"""A steeper plane in the map is a wall, even with 10 degrees of error of the guess. RANSAC of a
library cannot be constrained so."""

SCORED_POINTS = 1000
"""Points that a trial plane is scored on."""

FITTED_POINTS = 5000
"""Points that the winner is fitted to."""

MIN_POINTS = 30
"""Minimum number of points on a plane."""


def fit_ground(points: Array, distance: float, max_tilt_rad: float = MAX_TILT_RAD) -> Array | None:
    """The near-horizontal plane that most points (N, 3) lie on, metres, z roughly up.

    Within `distance` of it. Unit normal n (upwards) and offset d, (4,), with `n . p + d = 0`; None
    if no plane was found or it holds fewer than a tenth of the points.
    """
    if len(points) < MIN_POINTS:
        return None
    rng = np.random.default_rng(len(points))
    if len(points) > FITTED_POINTS:
        points = points[rng.choice(len(points), FITTED_POINTS, replace=False)]
    scored = points[rng.permutation(len(points))[:SCORED_POINTS]]
    triples = scored[rng.integers(0, len(scored), (TRIALS, 3))]
    normals = cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-9
    normals = normals[usable] / length[usable, None]
    normals *= np.where(normals[:, 2] < 0.0, -1.0, 1.0)[:, None]
    level = normals[:, 2] > math.cos(max_tilt_rad)
    if not level.any():
        return None
    normals = normals[level]
    offsets = -np.sum(normals * triples[usable][level, 0], axis=1)
    votes = (np.abs(scored @ normals.T + offsets) < distance).sum(axis=0)
    best = int(votes.argmax())
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        near = points[np.abs(points @ normal + offset) < distance]
        if len(near) < max(MIN_POINTS, 0.1 * len(points)):
            return None
        centre = near.mean(axis=0)
        _, axes = np.linalg.eigh((near - centre).T @ (near - centre))
        normal = axes[:, 0] * (1.0 if axes[2, 0] > 0.0 else -1.0)
        offset = -float(normal @ centre)
    return np.append(normal, offset)


def height_above(plane: Array, points: Array) -> Array:
    """Signed distances (N,) in metres of points (N, 3) above a plane (4,)."""
    return np.asarray(points @ plane[:3] + plane[3])
