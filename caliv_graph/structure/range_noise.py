"""Noise along the beam of a LiDAR by distance, from the scatter of the patches of a few scans.

What is stated is the least of it. Solid-state LiDARs have 20 mm at 10 m and twice that at 40 m: by
the usual 10 mm their walls are not flat, and those few patches that pass pretend less noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from caliv_graph.products import TargetObservation
from caliv_graph.structure.patches import DrivePatches, RangeNoise, scatter_of_ranges, spread_of
from caliv_graph.structure.planar import ScanPatches

OPEN_M = 0.06
"""Noise that patches may have when it is measured, 1 sigma: no LiDAR for vehicles has more at the
distance of walls."""

FIRST_M, WIDER, CLASSES = 2.0, 1.5, 9
"""Lower end of the first class of distance, the next over it, and how many: up to 77 m."""

LEAST_PATCHES = 10
"""Patches of a class at least."""

STEEP_COS = 0.35
"""Cosine of the incidence at least: at 70 degrees, bumps of 3 mm are 9 mm along the beam."""

SMOOTH_SHARE = 0.25
SMOOTH_NORMAL = -0.674
"""Share of the patches by which the noise is told, and the standard normal's quantile at it: the
smoothest are of walls and ground. Others are of leaves, which scatter by 30 mm and more."""


def measured_noise(found: Sequence[ScanPatches], stated_m: float) -> RangeNoise:
    """The noise of a LiDAR by the patches of scans, cut with `OPEN_M`; at least what is stated.

    Noise does not fall with the distance, and grows no faster than it: near or far leaves, of which
    there may be nothing else at some distance, are held by walls at another.
    """
    moments = np.concatenate([np.zeros((0, 4, 4)), *(of.moments for of in found)])
    normals = np.concatenate([np.zeros((0, 3)), *(of.normal_lidar for of in found)])
    points, (centres, cov) = moments[:, 3, 3], spread_of(moments)
    beams, scatter = scatter_of_ranges(centres, cov, points)
    # Over what a share of patches of noise alone is below (Wilson, Hilferty).
    part = 2.0 / (9.0 * np.maximum(points - 3.0, 1.0))
    scatter = scatter / (1.0 - part + SMOOTH_NORMAL * np.sqrt(part)) ** 1.5
    steep = -np.einsum("ni,ni->n", beams, normals) > STEEP_COS
    distance, scatter = np.linalg.norm(centres, axis=1)[steep], scatter[steep]
    number = np.floor(np.log(np.maximum(distance / FIRST_M, 1.0)) / np.log(WIDER))
    told = [own for k in range(CLASSES) if np.count_nonzero(own := number == k) >= LEAST_PATCHES]
    if not told:
        return RangeNoise.constant(stated_m)
    middles = np.array([np.median(distance[own]) for own in told])
    sigmas = np.array([np.quantile(scatter[own], SMOOTH_SHARE) for own in told])
    sigmas = np.minimum.accumulate(sigmas[::-1])[::-1]
    sigmas = middles * np.minimum.accumulate(sigmas / middles)
    return RangeNoise(middles, np.maximum(sigmas, stated_m))


def with_range_noise(
    observation: TargetObservation, patches: Sequence[DrivePatches]
) -> TargetObservation:
    """The clouds of a target, with the noise of the LiDARs at its distance by the patches around.

    The clouds themselves hardly tell it: a shape of many small surfels takes some of it up.
    """
    told: dict[str, float] = {}
    for name in dict.fromkeys(cloud.lidar for cloud in observation.clouds):
        for of in patches:
            noise = of.noise.get(of.lidars.index(name))
            clouds = [c for c in observation.clouds if (c.lidar, c.drive) == (name, of.drive)]
            if noise is None or not clouds:
                continue
            points = np.concatenate([cloud.points_lidar for cloud in clouds])
            distance_m = np.median(np.linalg.norm(points, axis=1), keepdims=True)
            told[name] = float(noise.at(distance_m)[0])
    return replace(observation, range_noise_m=told)
