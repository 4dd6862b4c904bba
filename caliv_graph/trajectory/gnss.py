"""GNSS fixes as positions in the map: ENU axes, origin at the first fix."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymap3d

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, GnssFixes, IntArray
from caliv_graph.trajectory.noise import gnss_covariances

ROUGH_RATIO = 3.0
"""Fixes that state this many times the sigma of the better ones are rough: the receiver has lost
its fixed ambiguities, or sees reflections."""

BETTER = 0.25
"""Quantile of the stated sigmas that stands for the better fixes."""

ROUGH_M = 0.05
"""And more than this: with fixed ambiguities 1 to 3 cm are stated, without 20 cm and more."""

ROUGH_TIME_S = 10.0
"""Correlation time of the errors of rough fixes: float ambiguities and reflections last for seconds
to minutes."""


@dataclass(frozen=True)
class Positions:
    """Positions of the GNSS antenna.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        position_map: (n, 3) metres, ENU about the first fix.
        cov_map: (n, 3, 3) m^2, of errors that are taken to be independent.
        shared: (n,) how many times as large `cov_map` is as the covariance of one fix, since rough
            fixes have errors in common; 1 for the others.
        origin_deg_m: latitude, longitude (degrees) and altitude (m) of the map's origin.
        source: of the covariances: messages, config, or the paper's table.
    """

    stamps_ns: IntArray
    position_map: Array
    cov_map: Array
    shared: Array
    origin_deg_m: tuple[float, float, float]
    source: str


def positions_in_map(
    gnss: GnssFixes, config: Config, name: str
) -> tuple[Positions, tuple[str, ...]]:
    """Converts fixes; those that are not finite or out of range are left out, with a warning.

    Raises:
        TrajectoryError: no fix is usable.
    """
    usable = np.isfinite(gnss.latitude_deg) & np.isfinite(gnss.longitude_deg)
    usable &= np.isfinite(gnss.altitude_m)
    usable &= (np.abs(gnss.latitude_deg) <= 90.0) & (np.abs(gnss.longitude_deg) <= 360.0)
    lost = int((~usable).sum())
    warnings = (f"{name}: {lost} of {len(usable)} GNSS fixes are not usable",) if lost else ()
    if not usable.any():
        raise TrajectoryError(
            f"{name}: none of {len(usable)} GNSS fixes has finite latitude, longitude and "
            "altitude. Choose another topics.gnss, or remove it"
        )
    cov, source = gnss_covariances(gnss, config)
    latitude, longitude = gnss.latitude_deg[usable], gnss.longitude_deg[usable]
    altitude = gnss.altitude_m[usable]
    origin = (float(latitude[0]), float(longitude[0]), float(altitude[0]))
    stamps = np.asarray(gnss.stamps_ns, dtype=np.int64)[usable]
    position_map = places_in_map(latitude, longitude, altitude, origin)
    cov = cov[usable]
    shared = shared_by_rough(stamps, cov)
    cov = cov * shared[:, None, None]
    return Positions(stamps, position_map, cov, shared, origin, source), warnings


def shared_by_rough(stamps_ns: IntArray, cov_map: Array) -> Array:
    """(n,) factors on stated covariances (n, 3, 3) of fixes for errors that rough ones share.

    Within a run of m rough fixes, dt apart, errors of correlation time T leave as much to their
    mean as independent ones of 2 T / dt times the variance do, and m times is all that can be.
    Fixes are rough by their horizontal sigma.
    """
    out = np.ones(len(stamps_ns))
    sigma = np.sqrt(0.5 * (cov_map[:, 0, 0] + cov_map[:, 1, 1]))
    rough = sigma > max(ROUGH_M, ROUGH_RATIO * float(np.quantile(sigma, BETTER)))
    if not rough.any():
        return out
    step_s = float(np.median(np.diff(stamps_ns))) * 1e-9
    edges = np.flatnonzero(np.diff(rough.astype(int), prepend=0, append=0))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        out[begin:end] = max(1.0, min(2.0 * ROUGH_TIME_S / step_s, end - begin))
    return out


def places_in_map(
    latitude_deg: Array,
    longitude_deg: Array,
    altitude_m: Array,
    origin_deg_m: tuple[float, float, float],
) -> Array:
    """(n, 3) metres east, north and up of `Positions.origin_deg_m`, of fixes (n,)."""
    enu = pymap3d.geodetic2enu(latitude_deg, longitude_deg, altitude_m, *origin_deg_m)
    return np.stack([np.asarray(axis, dtype=np.float64) for axis in enu], axis=1)


def normal_gravity(latitude_deg: float, altitude_m: float) -> float:
    """Gravity on the WGS84 ellipsoid (Somigliana), less its decrease with height, in m/s^2.

    True gravity differs by up to 0.001 m/s^2, which is below the bias of an accelerometer.
    Coefficients: WGS84 (NIMA TR8350.2, equation 4-1), free-air gradient 3.086e-6 1/s^2.
    """
    s = math.sin(math.radians(latitude_deg)) ** 2
    surface = 9.7803253359 * (1.0 + 0.00193185265241 * s) / math.sqrt(1.0 - 0.00669437999013 * s)
    return surface - 3.086e-6 * altitude_m
