"""Strips that are bent: roads have a crown, ground has waves, walls bulge.

Two LiDARs see a strip at different places of it, and along a road all strips bend alike: taken as
flat, the crown shifts one LiDAR against the other in every scan to the same side.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.structure.patches import fitted_over

BENDS = 3
"""Of a strip: curvature along its first axis, twist, curvature along its second axis, 1/m."""

USUAL_PER_M = 0.005
"""1 sigma of each where nothing tells, which counts as one strip: 2.5 mm in the middle of 2 m."""


def seen_bends(
    moments: Array,
    centres_lidar: Array,
    axes_lidar: Array,
    normals: Array,
    strip: IntArray,
    starts: IntArray,
) -> Array:
    """(Q, BENDS, 4) what a bend of 1/m adds to the residuals of sightings, linear in h = (p, 1).

    A strip is at the height `(a x^2 + 2 b x y + c y^2) / 2` above its plane. Within a patch that is
    linear, up to its mean, which is exact; over a sighting it is fitted by a plane. The mean over a
    strip is part of its plane.

    Args:
        moments: (n, 4, 4) weighted, of the patches, sighting by sighting, in the lidar frame.
        centres_lidar: (n, 3) of their strips in that frame.
        axes_lidar: (n, 2, 3) axes of their strips in that frame.
        normals: (n, 3) of their strips in that frame.
        strip: (n,) their strips.
        starts: (Q,) first patch of each sighting.
    """
    weight = moments[:, 3, 3]
    middle = moments[:, :3, 3] / weight[:, None]
    spread = moments[:, :3, :3] / weight[:, None, None] - middle[:, :, None] * middle[:, None]
    x, y = np.einsum("nki,ni->kn", axes_lidar, middle - centres_lidar)
    (xx, xy), (_, yy) = np.moveaxis(axes_lidar @ spread @ np.swapaxes(axes_lidar, 1, 2), 0, 2)
    height = np.stack([0.5 * (x**2 + xx), x * y + xy, 0.5 * (y**2 + yy)], axis=1)
    total = np.maximum(np.bincount(strip, weight), np.finfo(float).tiny)
    mean = [np.bincount(strip, weight * of) / total for of in height.T]
    height -= np.stack(mean, axis=1)[strip]
    none = np.zeros_like(x)
    slope = np.stack([np.stack([x, none], 1), np.stack([y, x], 1), np.stack([none, y], 1)], 1)
    by_point = np.zeros((len(x), BENDS, 4))
    by_point[:, :, :3] = slope @ axes_lidar
    by_point[:, :, 3] = height - np.einsum("nki,ni->nk", by_point[:, :, :3], middle)
    return -fitted_over(by_point, moments, normals, starts)
