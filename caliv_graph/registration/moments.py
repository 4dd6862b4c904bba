"""Weighted sums over points, per cloud and component, and the linear algebra on them.

The sums are formed once, in the frame of the LiDAR, and carried to the target frame by the pose of
each cloud. All M-steps are linear in them: matrix products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from caliv_graph.common.cores import share_out
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, second_moments
from caliv_graph.registration.heights import HeightSums

PART_CLOUDS = 8
"""Clouds whose points are summed together: their sums stay in the processor's cache."""

PRIOR_COUNT = 1e-8
"""Weight, per square metre, that keeps a surfel without points defined. More would add up over all
surfels to information on the place of the target, which no cloud has."""

MOMENTS = slice(0, 10)
"""Columns of `cell_moments`: sums of `alpha h h^T`, upper triangle, h of the points."""

NORMALS = slice(10, 13)
"""Sums of alpha times flatness times the normal of the points."""

SURFACE_MOMENTS = slice(13, 23)
"""As `MOMENTS`, h of the places where the beams meet the surface."""

ALONG_MOMENTS = slice(23, 33)
"""As `SURFACE_MOMENTS`, with the weights along the surface; where points are held there."""

# The upper triangle of h h^T, row by row, is what is stored: entry i is of (ROW[i], COLUMN[i]).

ROW, COLUMN = np.triu_indices(4)

HALF_DIAGONAL = np.where(ROW == COLUMN, 0.5, 1.0)
"""Makes of a sum over both triangles one over the stored entries."""

JACOBIAN = np.zeros((4, 3, 6))
"""E of `[-skew(y), I] = h_0 E_0 + h_1 E_1 + h_2 E_2 + h_3 E_3`."""
JACOBIAN[0, :, 3:] = np.eye(3)
JACOBIAN[1:, :, :3] = -skew(np.eye(3))


@dataclass(frozen=True)
class Responsibilities:
    """Which surfels the beams returned from: the result of the E-step.

    Attributes:
        component: (N, k) indices of surfels.
        weight: (N, k) responsibilities over the variance of the height, times the weight of the
            point's cloud, per square metre.
        weight_along: (N, k) the same along the surface; None where no points are held there.
        counts: (K,) points of each surfel.
        explained: (N,) probability that the point is target.
        inlier_ratio: (J,) its mean over each cloud.
        levers: (J, 3) correction of the rotation part of each cloud's gradient: the lever of a
            residual ends where the beam meets the surface, not at the point (`mixture.expect`).
        component_levers: (K, 3) the same, summed over the points of each surfel.
        slides_m: (N,) distance along the beam from each point to the surface, metres.
        heights: sums over the heights of the points, for their noise.
    """

    component: IntArray
    weight: Array
    weight_along: Array | None
    counts: Array
    explained: Array
    inlier_ratio: Array
    levers: Array
    component_levers: Array
    slides_m: Array
    heights: HeightSums

    @classmethod
    def joined(cls, parts: Sequence[Responsibilities]) -> Responsibilities:
        """Of clouds in a row, from E-steps of some of them each, at the same shape."""
        along = [part.weight_along for part in parts if part.weight_along is not None]
        return cls(
            component=np.concatenate([part.component for part in parts]),
            weight=np.concatenate([part.weight for part in parts]),
            weight_along=np.concatenate(along) if along else None,
            counts=np.sum([part.counts for part in parts], axis=0),
            explained=np.concatenate([part.explained for part in parts]),
            inlier_ratio=np.concatenate([part.inlier_ratio for part in parts]),
            levers=np.concatenate([part.levers for part in parts]),
            component_levers=np.sum([part.component_levers for part in parts], axis=0),
            slides_m=np.concatenate([part.slides_m for part in parts]),
            heights=HeightSums.total([part.heights for part in parts]),
        )


def cell_moments(stack: CloudStack, who: Responsibilities, components: int) -> Array:
    """(J, K, m) sums over the points of each cloud and component ("cell"), for K `components`.

    `MOMENTS`, `NORMALS`, `SURFACE_MOMENTS` and, where points are held along the surface,
    `ALONG_MOMENTS`: m = 23 or 33. Lidar axes, points less the centre of their cloud.
    """
    width = who.component.shape[1]
    ends = np.append(stack.starts, len(stack.points))
    features = stack.features
    along = who.weight_along
    columns = SURFACE_MOMENTS.stop if along is None else ALONG_MOMENTS.stop
    sums = np.empty((stack.count, components, columns))

    def of_clouds(first: int) -> None:
        last = min(first + PART_CLOUDS, stack.count)
        own, count = slice(ends[first], ends[last]), ends[last] - ends[first]
        cells = (stack.cloud[own, None] - first) * components + who.component[own]
        # A column per point, an entry per component it may belong to: the product is one pass.
        belongs = scipy.sparse.csc_array(
            (
                who.weight[own].ravel(),
                cells.ravel().astype(np.int32),
                np.arange(0, count * width + 1, width, dtype=np.int32),
            ),
            shape=((last - first) * components, count),
        )
        on_surface = second_moments(stack.centred[own] + who.slides_m[own, None] * stack.beams[own])
        part = sums[first:last].reshape(-1, columns)
        part[:, : NORMALS.stop] = np.asarray(belongs @ features[own])
        part[:, SURFACE_MOMENTS] = np.asarray(belongs @ on_surface)
        if along is not None:
            belongs.data = along[own].ravel()
            part[:, ALONG_MOMENTS] = np.asarray(belongs @ on_surface)

    share_out(of_clouds, range(0, stack.count, PART_CLOUDS))
    return sums


def to_target(stack: CloudStack, R: Array, t: Array) -> Array:
    """(J, 10, 10) that, from the right, carry moments from the lidar to the target frame."""
    A = np.zeros((stack.count, 4, 4))
    A[:, 0, 0] = 1.0
    A[:, 1:, 0] = np.einsum("jab,jb->ja", R, stack.centres) + t
    A[:, 1:, 1:] = R
    both = np.einsum("jac,jbd->jcdab", A, A)[..., ROW, COLUMN]
    both = both + np.swapaxes(both, 1, 2)
    return np.asarray(HALF_DIAGONAL[:, None] * both[:, ROW, COLUMN])


def mass_and_means(moments: Array, mixture: Mixture) -> tuple[Array, Array]:
    """(K,) weight and (K, 3) mean of each component's points from their (K, 10) moments."""
    mass = moments[:, 0] + PRIOR_COUNT
    return mass, (moments[:, 1:4] + PRIOR_COUNT * mixture.means_target) / mass[:, None]


def scatter_about(moments: Array, means: Array) -> Array:
    """(K, 3, 3) sums of `alpha (y - m) (y - m)^T` from (K, 10) moments and (K, 3) means."""
    full = np.empty((len(means), 4, 4))
    full[:, ROW, COLUMN] = full[:, COLUMN, ROW] = moments
    offset = np.zeros((len(means), 3, 4))  # of y - m in h
    offset[:, :, 0] = -means
    offset[:, :, 1:] = np.eye(3)
    return np.asarray(offset @ full @ np.swapaxes(offset, 1, 2))
