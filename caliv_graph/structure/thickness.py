"""Thickness of strips: how far their sightings lie from one plane."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.noise import range_sigmas
from caliv_graph.structure.problem import geometry_at, placed_patches, placed_sightings
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.solve import Solved

RIDGE = 1e-6
"""Prior of a fitted plane, in sightings: what one LiDAR sees from afar determines no tilt."""


TOGETHER = 4096
"""Sightings whose derivatives are computed at a time: temporary memory is small."""


def thickness_m(
    rows: Array, sightings: Sightings, weights: Array, offsets_m: Array, count: int
) -> Array:
    """(K, ...) root mean square distance of the sightings of each strip from a plane through them.

    Args:
        rows: (Q, 3) `Geometry.plane_rows`.
        sightings: Q of them.
        weights: (Q,) robust.
        offsets_m: (Q, ...) their distances from the plane at which `rows` were computed.
        count: K; a strip without weight is NaN.
    """
    # Nothing may be seen at the guesses: -1 would not tell how many there are.
    r = offsets_m.reshape(sightings.count, math.prod(offsets_m.shape[1:]))
    squares = np.full((count, r.shape[1]), np.nan)
    for k, own in enumerate(by_strip(sightings, count)):
        w = weights[own]
        if not w.sum() > 0.0:
            continue
        A = rows[own] * w[:, None]
        fitted = np.linalg.solve(rows[own].T @ A + RIDGE * np.eye(3), A.T @ r[own])
        squares[k] = w @ (r[own] - rows[own] @ fitted) ** 2 / w.sum()
    return np.asarray(np.sqrt(squares).reshape(count, *offsets_m.shape[1:]))


def by_strip(sightings: Sightings, count: int) -> list[IntArray]:
    """Indices of the sightings of each of K strips."""
    order = np.argsort(sightings.strip, kind="stable")
    ends = np.cumsum(np.bincount(sightings.strip, minlength=count))[:-1]
    return list(np.split(order, ends))


def weighted_alike(
    sightings: Sightings, weighted: Sightings, weights: Array
) -> tuple[Sightings, Array]:
    """The sightings that others (R,) with weights have too, and these weights.

    At other extrinsics a few more or less are at the limit of incidence.
    """
    first = max(int(of.strip.max(initial=0)) + 1 for of in (sightings, weighted))
    here, there = (of.scan * first + of.strip for of in (sightings, weighted))
    _, own, other = np.intersect1d(here, there, assume_unique=True, return_indices=True)
    order = np.argsort(own)
    return sightings.only(own[order]), weights[other[order]]


def thickness_at_guesses(found: Solved) -> Array:
    """(K,) of the strips of a solve with the guesses of the extrinsics and the poses of motion."""
    problem = found.problem
    R, t = stack(problem.prior.T_map_vehicle)
    state = replace(
        found.state,
        R_map_vehicle=R,
        t_map_vehicle=t,
        T_vehicle_lidar=problem.guesses,
        offsets_s=np.zeros_like(found.state.offsets_s),
        errors=np.zeros_like(found.state.errors),
    )
    # All errors are zero: what those of beams and bends would do takes most of the memory.
    problem = replace(problem, beam_nodes=(), bent=False)
    sigma = range_sigmas(problem.patches, problem.range_sigma_m)
    placed = placed_patches(problem, state)
    seen = placed_sightings(problem, placed, found.strips, sigma)
    sightings, weights = weighted_alike(seen, found.sightings, found.weights)
    rows, offsets = np.zeros((sightings.count, 3)), np.zeros(sightings.count)
    for begin in range(0, sightings.count, TOGETHER):
        own = np.arange(begin, min(begin + TOGETHER, sightings.count))
        some = sightings.only(own)
        geometry = geometry_at(problem, state, some, found.layout)
        rows[own], offsets[own] = geometry.plane_rows(some), geometry.offsets_m(some)
    return thickness_m(rows, sightings, weights, offsets, found.strips.count)


def thickness_at_estimate(found: Solved) -> Array:
    """(K,) of the strips of a solve."""
    count = found.strips.count
    return thickness_m(found.plane_rows, found.sightings, found.weights, found.offsets_m, count)
