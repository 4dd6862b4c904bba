"""The noise of the heights of points over the surface, estimated from them.

The range of LiDAR a has noise `sigma_a` along the beam, which is `f sigma_a` across a surface that
the beam meets at the cosine f. What a plane does not show of the surface, and what a footprint of
a beam averages, is across the surface: the roughness. Variances of a LiDAR's heights are
`f^2 sigma_a^2 + rho_a^2`, and both are fitted to the squares of the heights
(`README.md` of this folder).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray
from caliv_graph.registration.clouds import CloudStack

LEAST_SIGMA_M = 1e-3
"""Smallest roughness and noise of the range, metres: below what ranges are quantised to."""

LEAST_SHARED_M = 3e-3
"""What scans of one view share of a height, 1 sigma, at least. Surfels that were fitted to the
spots of few beams do not show what they miss between these. Measured on the faces of boxes by
repeated scans of two OS1-128: 3 to 4.5 mm."""

PRIOR_POINTS = 50.0
"""Points that the noise of the range as it is known before counts as when it is estimated."""


FAR_NEIGHBOURS, FAR_SIGMAS = 0.9, 1.6449
"""Quantile of the differences between neighbours, and its size in standard deviations. Leaves are
larger than what is between two beams: most neighbours lie on one. Of the pairs of a chair, less
than a tenth have an edge between them."""

FEWEST_NEIGHBOURS = 50
"""Pairs of neighbours that tell the scatter of a LiDAR's points."""

ON_TARGET = 0.5
"""Probability from which on a point is taken for one of the target."""

OTHER_CLOUD = 10.0
"""What keeps the beams of two clouds apart, in units of their directions."""


@dataclass(frozen=True)
class HeightNoise:
    """Noise of the heights of the points of L LiDARs.

    Attributes:
        range_m2: (L,) variance along the beam, m^2.
        roughness_m2: (L,) variance across the surface, m^2.
        floor_m: smallest roughness, metres; annealed while poses and shape are coarse.
    """

    range_m2: Array
    roughness_m2: Array
    floor_m: float

    @classmethod
    def configured(cls, lidars: int, sigma_range_m: Array | float, floor_m: float) -> HeightNoise:
        """The noise along the beam, of each LiDAR or of all, and the smallest roughness."""
        variance = np.maximum(np.full(lidars, sigma_range_m), LEAST_SIGMA_M) ** 2
        return cls(variance, np.full(lidars, LEAST_SIGMA_M**2), floor_m)

    def largest_m(self) -> float:
        """The largest standard deviation along a beam, metres."""
        return float(np.sqrt(self.range_m2.max()))

    def variance(self, cosine: Array, lidar: IntArray) -> Array:
        """(k, n) variance of heights at cosines of incidence (k, n), of points of LiDARs (n,)."""
        roughness = np.maximum(self.roughness_m2, self.floor_m**2)
        return np.asarray(cosine**2 * self.range_m2[lidar] + roughness[lidar])

    def shared_part(self, heights: HeightSums) -> Array:
        """(L,) part of a height's variance that scans from one place share.

        Their beams meet the same spots: the noise of the range is new in each scan, what the plane
        does not show is the same.
        """
        roughness = np.maximum(self.roughness_m2, LEAST_SHARED_M**2)
        return np.asarray(roughness / (heights.mean_cosine2() * self.range_m2 + roughness))

    def fitted(self, heights: HeightSums, parameters: float, before: HeightNoise) -> HeightNoise:
        """The noise that the squares of the heights ask for, by weighted least squares.

        Args:
            heights: of the E-step.
            parameters: what the shape has taken up, in points.
            before: the noise as it is known before, a prior of `PRIOR_POINTS`.
        """
        points = heights.points.sum()
        # Heights over planes that were fitted to them are too small; what a point gives to the
        # planes is in proportion to its weight.
        taken_up = parameters * heights.squares.sum() / max(points, 1e-12)
        inflation = points / max(points - taken_up, 0.2 * points)
        # Kish's number of points: that of as many of equal weight.
        prior = PRIOR_POINTS / np.maximum(heights.kish(), 1.0)
        range_m2, roughness_m2 = self.range_m2.copy(), self.roughness_m2.copy()
        for a in np.flatnonzero(heights.points > 0.0).tolist():
            A = heights.normal[a]
            b = inflation * heights.right[a]
            pull = prior[a] * np.diag(A)
            A = A + np.diag(pull)
            b = b + pull * [before.range_m2[a], before.roughness_m2[a]]
            both = np.linalg.solve(A, b)
            if both[0] < LEAST_SIGMA_M**2:
                both = np.array([LEAST_SIGMA_M**2, (b[1] - A[1, 0] * LEAST_SIGMA_M**2) / A[1, 1]])
            elif both[1] < LEAST_SIGMA_M**2:
                both = np.array([(b[0] - A[0, 1] * LEAST_SIGMA_M**2) / A[0, 0], LEAST_SIGMA_M**2])
            range_m2[a], roughness_m2[a] = np.maximum(both, LEAST_SIGMA_M**2)
        return replace(self, range_m2=range_m2, roughness_m2=roughness_m2)


@dataclass(frozen=True)
class HeightSums:
    """Sums over heights that their noise is fitted to, for L LiDARs.

    Attributes:
        points: (L,) points that are target, each with the weight of its cloud.
        squares: (L,) the same with squared weights.
        cosine2: (L,) sum of the squared cosines of incidence.
        normal: (L, 2, 2) normal matrix of squared heights by (f^2, 1), each of weight 1/variance^2.
        right: (L, 2) its right-hand side, m^2.
    """

    points: Array
    squares: Array
    cosine2: Array
    normal: Array
    right: Array

    @classmethod
    def none(cls, lidars: int) -> HeightSums:
        """Zero."""
        none = np.zeros(lidars)
        return cls(none, none, none, np.zeros((lidars, 2, 2)), np.zeros((lidars, 2)))

    @classmethod
    def of(
        cls,
        alpha: Array,
        weight: Array,
        height: Array,
        cosine: Array,
        variance: Array,
        cloud_weight: Array,
        lidar: IntArray,
        lidars: int,
    ) -> HeightSums:
        """Of responsibilities, these over the variances, heights, cosines and variances (k, n).

        Of points of LiDARs (n,). A cloud that is somewhere else says nothing of the noise:
        `cloud_weight` (n,) is that of the point's cloud.
        """
        f2, square, weight = cosine**2, height**2, weight / variance
        steep = weight * f2

        def summed(a: Array, b: Array) -> Array:
            return np.asarray(np.einsum("kn,kn->n", a, b))

        alphas, steeps, weights = (of.sum(axis=0) for of in (alpha, steep, weight))
        by_point = [alphas, alphas * cloud_weight, summed(alpha, f2)]
        by_point += [summed(steep, f2), steeps, steeps, weights]
        by_point += [summed(steep, square), summed(weight, square)]
        of_lidars = np.zeros((len(lidar), lidars))
        of_lidars[np.arange(len(lidar)), lidar] = cloud_weight
        points, squares, cosine2, *both = np.array(by_point) @ of_lidars
        normal, right = np.stack(both[:4], axis=1), np.stack(both[4:], axis=1)
        return cls(points, squares, cosine2, normal.reshape(lidars, 2, 2), right)

    @classmethod
    def total(cls, pieces: Sequence[HeightSums]) -> HeightSums:
        """The sum of several."""
        return cls(
            np.sum([p.points for p in pieces], axis=0),
            np.sum([p.squares for p in pieces], axis=0),
            np.sum([p.cosine2 for p in pieces], axis=0),
            np.sum([p.normal for p in pieces], axis=0),
            np.sum([p.right for p in pieces], axis=0),
        )

    def kish(self) -> Array:
        """(L,) how many points of equal weight these are worth."""
        return np.asarray(self.points**2 / np.maximum(self.squares, 1e-300))

    def mean_cosine2(self) -> Array:
        """(L,) mean squared cosine of incidence."""
        return np.asarray(self.cosine2 / np.maximum(self.points, 1e-12))


def scatter_of_neighbours(stack: CloudStack, slides_m: Array, explained: Array) -> Array:
    """(L,) scatter of the points of each LiDAR about the surface, within scans, 1 sigma, metres.

    From differences between each point of the target and the nearest one of its cloud by direction:
    a cloud that lies wrong has them alike, and foliage has none. NaN: a LiDAR has too few.

    Args:
        stack: the clouds.
        slides_m: (N,) distance of each point from the surface, along its beam.
        explained: (N,) probability that it is of the target.
    """
    own = np.flatnonzero(explained > ON_TARGET)
    out = np.full(stack.lidars, math.nan)
    if len(own) < 2:
        return out
    apart = np.column_stack([stack.beams[own], OTHER_CLOUD * stack.cloud[own]])
    # Drivers publish both returns of a beam, which may be one.
    apart, first = np.unique(apart, axis=0, return_index=True)
    own = own[first]
    nearest = own[np.asarray(cKDTree(apart).query(apart, 2)[1])[:, 1]]
    together = stack.cloud[own] == stack.cloud[nearest]
    own, nearest = own[together], nearest[together]
    apart_m = np.abs(slides_m[own] - slides_m[nearest])
    lidar = stack.lidar[stack.cloud[own]]
    for a in range(stack.lidars):
        of = apart_m[lidar == a]
        if len(of) >= FEWEST_NEIGHBOURS:
            out[a] = float(np.quantile(of, FAR_NEIGHBOURS)) / (FAR_SIGMAS * math.sqrt(2.0))
    return out
