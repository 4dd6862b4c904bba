"""The surfels that the beam of a point may have returned from, before its range is known.

Two ways to tell: by the point and its normal, while poses are wrong by centimetres; by the beam
alone at the end (`README.md` of this folder, *by beams*).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.special import expit

from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, IntArray, Mixture

NEIGHBOURS = 8
"""Surfels that a beam may return from: the nearest to the point. Farther ones have a negligible
density."""

NORMAL_METRES = 0.1
"""In the search for near surfels, opposite normals count as 2 x 0.1 m apart."""

BEAM_NEIGHBOURS = 12
"""The same where beams alone tell the surfel: those nearest across the beam."""

ALONG_BEAM = 4.0
"""A distance along the beam counts less by this factor in the search for these. The noise is along
it, and surfels about the noisy point itself are on the side that its noise chose."""

AWAY = -0.2
"""Cosine of incidence at the middle of a cloud below which none of its beams sees a surfel."""

EDGE_M = 0.004
"""At an edge between two surfels, metres: how much farther one of them is along the beam for it to
be the one that the beam returns from; and how far one lies behind the plane of the other for there
to be an edge. Thin parts are known to this."""

EDGE_REACH_M = 0.1
"""Surfels that are farther apart have no edge in common."""

PAIRED = 4
"""Of the surfels near a beam, those that edges are looked for between: the most present."""

LEAST_SEEN = 1e-3
"""What is left of the presence of a surfel that is hidden at edges."""

NORMAL_CONCENTRATION = 4.0
"""Concentration of a reliable normal about that of its surfel (von Mises-Fisher, times flatness):
0.5 rad. Normals of neighbouring points share their errors at edges."""

GRAZING = 0.05
"""Cosine of incidence about which a surfel begins to be visible: a normal is not known better."""

STEEP = 0.1
"""Cosine of incidence below which the intersection of beam and plane is damped: the normal is not
known well enough to compute it."""

BESIDE = 1e-4
"""Presence of "no surface here" in the weights of the surfels along a beam: a beam that passes a
surfel at more than 4.3 of its widths does not return from it."""

ORDER_BITS = 4
"""Bits per axis of the cells in whose order points are looked up: 16 cells across the target. One
look-up follows another nearby, and takes three quarters of the time."""


class Surfels:
    """The surfels for the E-step: means and normals (3, K), and factors (K,) of the exponents.

    They lie on surfaces: boxes halved in the middle fit them better than those halved in number,
    and the search in trees of them is a sixth faster.
    """

    def __init__(self, mixture: Mixture) -> None:
        self.low = mixture.means_target.min(axis=0)
        self.extent_m = max(float(np.ptp(mixture.means_target, axis=0).max()), 1e-6)
        self.aside = -0.5 / mixture.var_tangent
        self.means = mixture.means_target.T.copy()
        self.normals = mixture.normals_target.T.copy()

    @property
    def count(self) -> int:
        """Number of surfels, K."""
        return len(self.aside)

    @cached_property
    def tree(self) -> cKDTree:
        """For the search by points and their normals."""
        places = np.vstack([self.means, NORMAL_METRES * self.normals]).T
        return cKDTree(places, balanced_tree=False)

    def nearest(self, points: Array, normals: Array) -> IntArray:
        """(n, k) surfels nearest to points with normals (n, 3)."""
        # Along a curve that fills space (Morton): what the search reads is in the cache.
        cell = (points - self.low) * (2**ORDER_BITS / self.extent_m)
        cell = np.clip(cell, 0, 2**ORDER_BITS - 1).astype(np.int16)
        along = np.zeros(len(cell), dtype=np.int16)
        for bit in range(ORDER_BITS):
            for axis in range(3):
                along |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
        order = np.argsort(along, kind="stable")
        places = np.column_stack([points, NORMAL_METRES * normals])[order]
        found = np.empty((len(points), min(NEIGHBOURS, self.count)), dtype=np.int64)
        found[order] = np.reshape(self.tree.query(places, found.shape[1])[1], found.shape)
        return found

    def nearest_to_beams(self, points: Array, beams: Array, cloud: IntArray) -> IntArray:
        """(n, k) surfels nearest to the beams of points (n, 3) of clouds (n,), ascending."""
        found = np.empty((len(points), min(BEAM_NEIGHBOURS, self.count)), dtype=np.int64)
        starts = np.flatnonzero(np.diff(cloud, prepend=-1))
        along = np.add.reduceat(beams, starts, axis=0)
        along /= np.linalg.norm(along, axis=1)[:, None]
        axes = np.concatenate([tangent_axes(along), along[:, None] / ALONG_BEAM], axis=1)
        faces = -(along @ self.normals) > AWAY
        ends = np.append(starts, len(cloud)).tolist()
        for (first, end), own, seen in zip(pairwise(ends), axes, faces, strict=True):
            facing = np.flatnonzero(seen)
            if len(facing) < found.shape[1]:
                facing = np.arange(self.count)
            places = (own @ self.means[:, facing]).T
            tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
            near = tree.query(points[first:end] @ own.T, found.shape[1])[1]
            found[first:end] = facing[np.reshape(near, (end - first, -1))]
        return found

    @cached_property
    def edges(self) -> npt.NDArray[np.float32]:
        """(K, K) 1 where two surfels meet at an edge that sticks out, -1 at one that is hollow.

        At the first each lies behind the plane of the other, at the second before it.
        """
        square = np.sum(self.means**2, axis=0)
        apart2 = square + square[:, None] - 2.0 * self.means.T @ self.means
        k, other = np.nonzero(apart2 < EDGE_REACH_M**2)
        heights = self.normals.T @ self.means
        heights -= np.diag(heights)[:, None]  # of surfel l over the plane of surfel k
        one, two = heights[k, other], heights[other, k]
        bend = np.maximum(-np.maximum(one, two), 0.0) - np.maximum(np.minimum(one, two), 0.0)
        edges = np.zeros(apart2.shape, np.float32)
        edges[k, other] = np.tanh(bend / EDGE_M)
        return edges

    def _hidden_at_edges(self, found: IntArray, there: Array, slide: Array) -> None:
        """Takes from `there` (k, n) the surfels whose planes the beams meet beyond an edge.

        Two planes that stick out at their edge: a beam returns from the farther, the nearer one it
        meets in the air. At a hollow edge it returns from the nearer.
        """
        paired = min(PAIRED, len(there))
        kept = np.argpartition(there, -paired, axis=0)[-paired:]
        surfel, own, s = (np.take_along_axis(a, kept, axis=0) for a in (found, there, slide))
        share = own / (own.sum(axis=0) + BESIDE)
        lost = np.zeros_like(own)
        for k, other in combinations(range(len(own)), 2):
            edge = self.edges.take(surfel[k] * self.count + surfel[other])
            farther = expit((s[k] - s[other]) / EDGE_M)
            out, hollow = np.maximum(edge, 0.0), np.maximum(-edge, 0.0)
            lost[k] += share[other] * (out * (1.0 - farther) + hollow * farther)
            lost[other] += share[k] * (out * farther + hollow * (1.0 - farther))
        own *= np.clip(1.0 - lost, LEAST_SEEN, 1.0)
        np.put_along_axis(there, kept, own, axis=0)

    def met_by(
        self,
        points: Array,
        normals: Array,
        beams: Array,
        flatness: Array,
        reach_m: float,
        cloud: IntArray | None = None,
        near: IntArray | None = None,
    ) -> Met:
        """What the beams of points meet; all (n, 3), flatness (n,), target frame.

        With their clouds (n,), ascending, beams alone tell which surfels, and not the normals of
        the points. `near` (n, k) are those to look at, by an earlier search; None: searched for.
        """
        if near is not None:
            pass
        elif cloud is None:
            near = self.nearest(points, normals)
        else:
            near = self.nearest_to_beams(points, beams, cloud)
        found = np.ascontiguousarray(near.T)
        height, all2, agreement, facing, depth = (np.zeros(found.shape) for _ in range(5))
        of_points = (np.ascontiguousarray(v.T) for v in (points, normals, beams))
        of_surfels = []
        for axis, (p, normal, beam) in enumerate(zip(*of_points, strict=True)):
            n = self.normals[axis].take(found)
            offset = p - self.means[axis].take(found)
            height += offset * n
            all2 += offset * offset
            agreement += n * normal
            facing -= n * beam
            depth += offset * beam
            of_surfels.append(n)
        # From the point along its beam to the surface, damped where the beam grazes it.
        slide = height * np.maximum(facing, 0.0) / np.maximum(facing, STEEP) ** 2
        slide = np.clip(slide, -reach_m, reach_m)
        aside2 = all2 + slide * (2.0 * depth + slide) - (height - facing * slide) ** 2
        visible = np.clip((facing + GRAZING) / (2.0 * GRAZING), 0.0, 1.0)
        there = np.exp(self.aside.take(found) * np.maximum(aside2, 0.0)) * visible
        if cloud is not None:
            self._hidden_at_edges(found, there, slide)
        # Where the beam returns from, if it does: surfels share it.
        presence = there / (there.sum(axis=0) + BESIDE)
        if cloud is None:
            presence *= _agreement(flatness, agreement)
        return Met(near, presence, height, slide, facing, of_surfels)


@dataclass(frozen=True)
class Met:
    """The surfels near n points, (k, n) each: numpy is fast along the points.

    Attributes:
        near: (n, k) indices of the surfels.
        presence: what the likelihood has of a surfel before the range is known: that it is visible,
            reaches to where the beam meets its plane, and agrees with the point's normal or, by
            beams, is not hidden at an edge.
        height: of the point over it, metres.
        slide: along the beam to it, metres.
        facing: cosine of incidence.
        normals: its normal, an array per axis.
    """

    near: IntArray
    presence: Array
    height: Array
    slide: Array
    facing: Array
    normals: Sequence[Array]


def _agreement(flatness: Array, cosine: Array) -> Array:
    """(k, n) density of normals (n,) whose flatness is given about those of surfels.

    Von Mises-Fisher, in units of the uniform density on the sphere, which outliers have; `cosine`
    (k, n) between the two.
    """
    kappa = np.maximum(NORMAL_CONCENTRATION * flatness, 1e-6)
    uniform = 2.0 * kappa / -np.expm1(-2.0 * kappa)
    return np.asarray(uniform * np.exp(kappa * (cosine - 1.0)))
