"""Clouds of a simulated drive as `velodyne_msgs/VelodyneScan`: the packets that a VLP-16 sends.

Every shot is cast from where its laser is at the time of the shot, in the order of firing of the
manual, so nothing is interpolated between the simulator and the decoder.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from caliv_graph.products import Array
from caliv_graph.readers.velodyne_packets import BLOCKS, MODELS, PACKET_BYTES, SHOTS
from caliv_graph.scenario.model import Scenario
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.simulation.recording import HEAVE_PERIOD_NS, SimulatedRecording
from scripts._dialects_motion import Message, time_message

NUMBER, STRONGEST = 0x22, 0x37
"""Factory bytes: VLP-16, the strongest return."""

LIDAR = MODELS[NUMBER]
TURN_DEG_S = 3600.0
SCAN_PACKETS = 76
"""Of one message, at 10 turns a second: the first number of packets that cover a turn."""

DRIVER_NS = 50_000
"""From the last shot of a packet to its stamp: the driver stamps what it has received."""

RANGE_M = (0.5, 100.0)
_HOUR_US = 3_600_000_000


def velodyne_scans(scenario: Scenario, seed: int, topics: Mapping[str, str]) -> Iterator[Message]:
    """The messages of LiDARs in place of the scenario's, at their mountings, with their noise.

    `topics` has a topic per LiDAR.
    """
    drive = SimulatedRecording(scenario, seed)
    caster = RayCaster(drive.world)
    packet_ns = round(BLOCKS * LIDAR.block_us * 1000)
    scan_ns = packet_ns * SCAN_PACKETS
    shots_us = LIDAR.block_us * np.arange(BLOCKS)[:, None] + LIDAR.shot_times_us()
    shots_ns = np.rint(1000 * shots_us).astype(np.int64)
    for index, (name, topic) in enumerate(topics.items()):
        model = scenario.lidars[name]
        rng = np.random.default_rng([seed, 2, index])
        T_vehicle_lidar = model.mounting.pose()
        # The LiDARs are not synchronised: each begins at a time of its own.
        first_ns = drive.truth.start_ns + int(rng.integers(scan_ns))
        for begin_ns in range(first_ns, drive.truth.end_ns - scan_ns, scan_ns):
            packets = begin_ns + packet_ns * np.arange(SCAN_PACKETS)
            heave_m = drive.truth.heave_m[(begin_ns - drive.truth.start_ns) // HEAVE_PERIOD_NS]
            at_ns = (packets[:, None, None] + shots_ns).ravel()
            states = drive.truth.drive.states(
                at_ns - drive.truth.start_ns, drive.truth.level_z_map + heave_m
            )
            origins, directions = _beams(at_ns)
            R_map_lidar = states.R_map_vehicle @ T_vehicle_lidar.rotation().matrix()
            t_map_lidar = states.position_map + states.R_map_vehicle @ T_vehicle_lidar.translation()
            true_m, _ = caster.cast(
                t_map_lidar + np.einsum("nij,nj->ni", R_map_lidar, origins),
                np.einsum("nij,nj->ni", R_map_lidar, directions),
                (at_ns - drive.truth.start_ns) * 1e-9,
            )
            noise_m = model.range_sigma_m * rng.standard_normal(len(true_m))
            ranges_m = true_m + noise_m + drive.truth.range_bias_m[name]
            seen = (ranges_m > RANGE_M[0]) & (ranges_m < RANGE_M[1])
            counts = np.where(seen, np.rint(np.where(seen, ranges_m, 0.0) / LIDAR.range_m), 0.0)
            stamps = packets + packet_ns + DRIVER_NS
            fields = _scan(packets, stamps, counts.astype(np.uint16))
            yield (int(stamps[-1]), topic, "velodyne_msgs/msg/VelodyneScan", fields)


def _block_azimuths(packets_ns: Any) -> Any:
    """(P, 12) hundredths of a degree at the first shot of each block, as the LiDAR rounds them."""
    # Whole seconds off: a float has no nanoseconds beside them.
    at_ns = packets_ns[:, None] % 10**9 + 1000.0 * LIDAR.block_us * np.arange(BLOCKS)
    return np.rint(100.0 * _azimuth_deg(at_ns)).astype(np.int64) % 36000


def _azimuth_deg(at_ns: Any) -> Array:
    """Where the motor is, clockwise, at times in nanoseconds."""
    return np.asarray(np.mod(np.mod(at_ns, 10**9) * 1e-9 * TURN_DEG_S, 360.0))


def _beams(at_ns: Any) -> tuple[Array, Array]:
    """(n, 3) origins and (n, 3) directions of shots, lidar frame: x forward, y left, z up."""
    laser = np.arange(len(at_ns)) % SHOTS % LIDAR.lasers
    azimuth = np.radians(_azimuth_deg(at_ns) + np.array(LIDAR.azimuth_deg)[laser])
    elevation = np.radians(LIDAR.elevation_deg)[laser]
    level = np.cos(elevation)
    directions = np.column_stack(
        [level * np.cos(azimuth), -level * np.sin(azimuth), np.sin(elevation)]
    )
    origins = np.zeros((len(at_ns), 3))
    origins[:, 2] = np.array(LIDAR.height_m)[laser]
    return origins, directions


def _scan(packets_ns: Any, stamps_ns: Any, counts: Any) -> dict[str, Any]:
    """The fields of a message.

    Packets begin and are stamped at (P,) times; counts (n,) are in the order of the shots.
    """
    azimuth = _block_azimuths(packets_ns)
    data = np.zeros((len(packets_ns), PACKET_BYTES), np.uint8)
    blocks = data[:, : BLOCKS * 100].reshape(-1, BLOCKS, 100)
    blocks[..., :2] = (0xFF, 0xEE)
    blocks[..., 2], blocks[..., 3] = azimuth % 256, azimuth // 256
    shots = blocks[..., 4:].reshape(-1, BLOCKS, SHOTS, 3)
    counts = counts.reshape(-1, BLOCKS, SHOTS)
    shots[..., 0], shots[..., 1], shots[..., 2] = counts % 256, counts // 256, 9
    blocks[..., 4:] = shots.reshape(-1, BLOCKS, 96)
    own_us = (packets_ns // 1000 % _HOUR_US).astype("<u4")
    data[:, 1200:1204] = own_us.view(np.uint8).reshape(-1, 4)
    data[:, 1204:] = (STRONGEST, NUMBER)
    return {
        "header": {"stamp": time_message(int(stamps_ns[-1])), "frame_id": "velodyne"},
        "packets": [
            {"stamp": time_message(int(stamp)), "data": body}
            for stamp, body in zip(stamps_ns, data, strict=True)
        ],
    }
