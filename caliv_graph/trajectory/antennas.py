"""Heading by two antennas, as an angle or as the difference of their fixes (`README.md`, 16)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.heading import HeadingAxes
from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, GnssFixes, HeadingSamples, IntArray, MotionData
from caliv_graph.trajectory.gnss import Positions, places_in_map
from caliv_graph.trajectory.imu import DeadReckoning, interpolate
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.noise import gnss_covariances

DEFAULT_HEADING_RAD = math.radians(0.3)
"""1 sigma of a heading whose message states none: two antennas a metre apart."""

MAX_APART_NS = 150_000_000
"""Largest time from a fix of one antenna to one of the other, between which the path is straight:
at 1 m/s^2 over 0.1 s it is off by a millimetre."""

MIN_BASELINE_M = 0.2
"""A shorter one tells nothing beside the centimetre of a fix."""


@dataclass(frozen=True)
class Headings:
    """Directions of a baseline over ground.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        azimuth_rad: (n,) from the map's x (east) to the left.
        var: (n,) rad^2.
        source: of the variances: messages, config, or a default.
    """

    stamps_ns: IntArray
    azimuth_rad: Array
    var: Array
    source: str


@dataclass(frozen=True)
class Baselines:
    """Second antenna less first, in the map.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        vector_map: (n, 3) metres.
        cov_map: (n, 3, 3) m^2.
        source: of the covariances.
    """

    stamps_ns: IntArray
    vector_map: Array
    cov_map: Array
    source: str


@dataclass(frozen=True)
class NodeDirections:
    """Measurements of directions at their nodes.

    Attributes:
        nodes: (m,) indices, one per measurement.
        measurements: (m,) index of each into what it was made from.
        direction_imu: (m, 3) baseline in the IMU's axes at the node: of unit length, or metres.
    """

    nodes: IntArray
    measurements: IntArray
    direction_imu: Array


def azimuth_of(yaw_rad: Array, axes: HeadingAxes) -> Array:
    """(n,) angles from the map's x (east) to the left, of angles as their source counts them."""
    return yaw_rad if axes == "enu" else 0.5 * math.pi - yaw_rad


def headings_of(samples: HeadingSamples, config: Config) -> Headings:
    """Angles of messages in the map."""
    azimuth, var = azimuth_of(samples.yaw_rad, config.heading.axes), samples.var
    sigma_deg = config.noise.heading_deg
    if sigma_deg is not None:
        every = np.full(len(azimuth), math.radians(sigma_deg) ** 2)
        return Headings(samples.stamps_ns, azimuth, every, "config")
    if var is None:
        every = np.full(len(azimuth), DEFAULT_HEADING_RAD**2)
        return Headings(samples.stamps_ns, azimuth, every, "two antennas a metre apart")
    known = np.where(np.isnan(var), np.nanmedian(var), var)
    return Headings(samples.stamps_ns, azimuth, known, "messages")


def baselines_of(second: GnssFixes, first: Positions, config: Config, name: str) -> Baselines:
    """The fixes of the second antenna less those of the first, interpolated to their stamps.

    Raises:
        TrajectoryError: the config does not say where the antennas are, or no two fixes are close
            in time.
    """
    arm, own = config.heading.lever_arm, config.gnss.lever_arm
    if arm is None or own is None or math.dist(arm, own) < MIN_BASELINE_M:
        raise TrajectoryError(
            f"{name}: topics.heading has fixes of a second antenna: set heading.lever_arm and "
            f"gnss.lever_arm, the places of the two, at least {MIN_BASELINE_M:g} m apart"
        )
    after = np.clip(np.searchsorted(first.stamps_ns, second.stamps_ns), 1, len(first.stamps_ns) - 1)
    before = after - 1
    apart = np.abs(np.stack([first.stamps_ns[before], first.stamps_ns[after]]) - second.stamps_ns)
    kept = (apart.max(axis=0) <= MAX_APART_NS) | (apart.min(axis=0) == 0)
    if not kept.any():
        raise TrajectoryError(
            f"{name}: no fix of topics.heading is within {MAX_APART_NS * 1e-9:g} s of fixes of "
            "topics.gnss before and after it. Check their clocks with 'caliv-graph inspect'"
        )
    cov, source = gnss_covariances(second, config)
    stamps = np.asarray(second.stamps_ns, np.int64)[kept]
    place = places_in_map(
        second.latitude_deg[kept],
        second.longitude_deg[kept],
        second.altitude_m[kept],
        first.origin_deg_m,
    )
    vector = place - interpolate(stamps, first.stamps_ns, first.position_map)
    # What rough fixes of two antennas have in common is not in their difference.
    cov_first = first.cov_map[after][kept] / first.shared[after][kept, None, None]
    return Baselines(stamps, vector, cov[kept] + cov_first, source)


def directions_of(
    motion: MotionData, positions: Positions | None, config: Config
) -> tuple[Headings | None, Baselines | None]:
    """What `topics.heading` says; None: it has no angles, or no fixes.

    Raises:
        TrajectoryError: it has fixes that do not make a baseline.
    """
    if isinstance(motion.heading, HeadingSamples):
        return headings_of(motion.heading, config), None
    if motion.heading is None:
        return None, None
    if positions is None:
        raise TrajectoryError(
            f"{motion.name}: topics.heading has fixes of a second antenna, and topics.gnss none "
            "of the first: set it to the topic of the first antenna"
        )
    return None, baselines_of(motion.heading, positions, config, motion.name)


def directions_at_nodes(
    stamps_ns: IntArray,
    direction_imu: Array,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    late_ns: int = 0,
) -> NodeDirections | None:
    """Measurements within the trajectory, a direction (3,) of the IMU's frame carried to nodes.

    `late_ns` are the stamps less the true times.
    """
    own = np.flatnonzero((stamps_ns >= nodes_ns[0]) & (stamps_ns <= nodes_ns[-1]))
    if not len(own):
        return None
    node = nearest_node(nodes_ns, stamps_ns[own])
    dR, _, _ = dead.between(nodes_ns[node], stamps_ns[own] - late_ns)
    return NodeDirections(node, own, dR @ direction_imu)


def yaw_by_antennas(
    R_map_imu: Array,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    measured: Sequence[tuple[IntArray, Array, Array]],
) -> float | None:
    """The turn about the vertical that brings rotations (n, 3, 3) to the measured directions.

    `measured` are stamps (m,), azimuths (m,) and the direction (3,) in the imu frame. None: no
    measurement is within the nodes. The mean of the angles between, as unit vectors.
    """
    total = 0.0 + 0.0j
    for stamps, azimuth, direction in measured:
        found = directions_at_nodes(stamps, direction, nodes_ns, dead)
        if found is not None:
            seen = np.einsum("nij,nj->ni", R_map_imu[found.nodes], found.direction_imu)
            angle = azimuth[found.measurements] - np.arctan2(seen[:, 1], seen[:, 0])
            total += complex(np.exp(1j * angle).sum())
    return math.atan2(total.imag, total.real) if total else None
