"""Noise along the beam of a LiDAR by distance, from the scatter of the patches of a few scans.

What is stated is the least of it. Solid-state LiDARs have 20 mm at 10 m and twice that at 40 m: by
the usual 10 mm their walls are not flat, and those few patches that pass pretend less noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array
from caliv_graph.structure.patches import scatter_of_ranges

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
"""Share of the patches that are of smooth surfaces, at least; their quantile is the noise. Others
are of leaves, which scatter by 30 mm and more of themselves."""


@dataclass(frozen=True)
class RangeNoise:
    """Noise along the beam, 1 sigma, linear in between, constant beyond both ends.

    Attributes:
        distances_m: (k,) ascending.
        sigmas_m: (k,) there.
    """

    distances_m: Array
    sigmas_m: Array

    @classmethod
    def constant(cls, sigma_m: float) -> RangeNoise:
        """The same at all distances."""
        return cls(np.ones(1), np.full(1, sigma_m))

    def at(self, distance_m: Array) -> Array:
        """(n,) 1 sigma in metres at these distances (n,)."""
        return np.asarray(np.interp(distance_m, self.distances_m, self.sigmas_m))


def measured_noise(
    moments: Sequence[Array], normals_lidar: Sequence[Array], stated_m: float
) -> RangeNoise:
    """The noise of a LiDAR by its patches, at least what is stated.

    Noise does not fall with the distance, and grows no faster than it: near or far leaves, of which
    there may be nothing else at some distance, are held by walls at another.

    Args:
        moments: of each scan (n, 4, 4) of its patches, as in `ScanPatches`, cut with `OPEN_M`.
        normals_lidar: of each scan (n, 3).
        stated_m: 1 sigma.
    """
    of_all = np.concatenate([np.zeros((0, 4, 4)), *moments])
    normals = np.concatenate([np.zeros((0, 3)), *normals_lidar])
    points = of_all[:, 3, 3]
    centres = of_all[:, :3, 3] / points[:, None]
    cov = of_all[:, :3, :3] / points[:, None, None] - centres[:, :, None] * centres[:, None, :]
    beams, scatter = scatter_of_ranges(centres, cov, points)
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
