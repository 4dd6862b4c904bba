"""Packets of Velodyne LiDARs (`velodyne_msgs/VelodyneScan`) as points with times.

A packet has 12 blocks of 100 bytes: flag, azimuth (0.01 degrees, clockwise), 32 ranges with
intensities; then the time of its first shot (microseconds of the hour) and two factory bytes, the
return mode and the model. Angles, timing and layout are those of the manuals of VLP-16, VLP-32C and
HDL-32E.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.readers.bag import DamagedMessageError
from caliv_graph.readers.pointcloud2 import DecodedCloud, TimeField, UnusableCloudsError
from caliv_graph.readers.returns import is_return

PACKET_BYTES = 1206
BLOCKS, SHOTS = 12, 32
_DUAL = 0x39
_UPPER, _LOWER = 0xEEFF, 0xDDFF
_HOUR_US = 3_600_000_000

_FIELD = TimeField("packets", "uint32", "us of the hour, absolute")

_OWN_CLOCK_US = 2
"""By which the stamp of a packet may differ from its own time of the hour if it was made from it;
else it is the time of its reception, when it was complete."""


@dataclass(frozen=True)
class Model:
    """One kind of LiDAR, from its manual.

    Attributes:
        name: of the LiDAR.
        elevation_deg: per laser, in the order of firing.
        azimuth_deg: offset of each laser, clockwise.
        height_m: of the origin of each laser over the LiDAR's.
        range_m: unit of the ranges.
        sequence_us: from one firing of all lasers to the next.
        shot_us: from one shot to the next.
        together: lasers that fire at once.
    """

    name: str
    elevation_deg: tuple[float, ...]
    azimuth_deg: tuple[float, ...]
    height_m: tuple[float, ...]
    range_m: float
    sequence_us: float
    shot_us: float
    together: int = 1

    @property
    def lasers(self) -> int:
        """How many it has: 16 fire twice in a block, 32 once."""
        return len(self.elevation_deg)

    def shot_times_us(self) -> Array:
        """(32,) microseconds of the shots of a block after its first."""
        shot = np.arange(SHOTS)
        within = shot % self.lasers // self.together * self.shot_us
        return np.asarray(shot // self.lasers * self.sequence_us + within)

    @property
    def block_us(self) -> float:
        """Microseconds from one block to the next, of a single return."""
        return self.sequence_us * SHOTS / self.lasers


MODELS = {
    0x22: Model(
        "VLP-16",
        (
            *(-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0),
            *(-7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0),
        ),
        (0.0,) * 16,
        (
            *(0.0112, -0.0007, 0.0097, -0.0022, 0.0081, -0.0037, 0.0066, -0.0051),
            *(0.0051, -0.0066, 0.0037, -0.0081, 0.0022, -0.0097, 0.0007, -0.0112),
        ),
        range_m=0.002,
        sequence_us=55.296,
        shot_us=2.304,
    ),
    0x28: Model(
        "VLP-32C",
        (
            *(-25.0, -1.0, -1.667, -15.639, -11.31, 0.0, -0.667, -8.843),
            *(-7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4.0),
            *(-4.667, 1.667, 1.0, -3.667, -3.333, 3.333, 2.333, -2.667),
            *(-3.0, 7.0, 4.667, -2.333, -2.0, 15.0, 10.333, -1.333),
        ),
        (
            *(1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4),
            *(1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4),
            *(1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
            *(1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
        ),
        (0.0,) * 32,
        range_m=0.004,
        sequence_us=55.296,
        shot_us=2.304,
        together=2,
    ),
    0x21: Model(
        "HDL-32E",
        (
            *(-30.67, -9.33, -29.33, -8.0, -28.0, -6.67, -26.67, -5.33),
            *(-25.33, -4.0, -24.0, -2.67, -22.67, -1.33, -21.33, 0.0),
            *(-20.0, 1.33, -18.67, 2.67, -17.33, 4.0, -16.0, 5.33),
            *(-14.67, 6.67, -13.33, 8.0, -12.0, 9.33, -10.67, 10.67),
        ),
        (0.0,) * 32,
        (0.0,) * 32,
        range_m=0.002,
        sequence_us=46.08,
        shot_us=1.152,
    ),
}
"""By the second factory byte."""


def decode_velodyne(
    message: Any, stamp_ns: int, min_range: float, max_range: float
) -> DecodedCloud:
    """Decodes a `velodyne_msgs/VelodyneScan`.

    Of two returns of a shot the last one is taken. Times count from `stamp_ns`, the stamp of the
    first or the last packet; returns outside the ranges (metres) are dropped.

    Raises:
        DamagedMessageError: a packet has the wrong size, or flags of no Velodyne.
        UnusableCloudsError: the model is not known, or needs a calibration of its own.
    """
    packets = list(message.packets)
    if not packets:
        return DecodedCloud(np.empty((0, 3)), None)
    if any(len(packet.data) != PACKET_BYTES for packet in packets):
        raise DamagedMessageError(f"has a packet that is not of {PACKET_BYTES} bytes")
    data = np.stack([np.frombuffer(bytes(packet.data), np.uint8) for packet in packets])
    model = _model(data)
    dual = int(data[0, 1204]) == _DUAL
    blocks = data[:, :1200].reshape(-1, BLOCKS, 100)[:, :: 2 if dual else 1]
    azimuth_deg, within_us = _azimuths(blocks, model)
    shots = blocks[:, :, 4:].reshape(*blocks.shape[:2], SHOTS, 3)
    counts = shots[..., 0] + shots[..., 1].astype(np.uint16) * 256
    ranges = counts.astype(np.float64) * model.range_m
    points = _points(ranges, azimuth_deg, model).reshape(-1, 3)
    times_s = _packet_times_s(packets, data, stamp_ns, blocks.shape[1] * model.block_us)
    times = (times_s[:, None, None] + within_us * 1e-6).reshape(-1)
    kept = is_return(points, min_range, max_range) & (ranges.reshape(-1) > 0.0)
    return DecodedCloud(points[kept], times[kept], _FIELD)


def _model(data: Any) -> Model:
    flags = data[:, 0].astype(int) + 256 * data[:, 1].astype(int)
    seen = set(flags.tolist())
    if _LOWER in seen:
        raise UnusableCloudsError(
            "packets of an HDL-64E need the calibration of that very LiDAR: decode them with "
            "velodyne_pointcloud's cloud_node (transform_node) and its calibration file"
        )
    if seen != {_UPPER}:
        raise DamagedMessageError("has a packet without the flag of a Velodyne (FF EE)")
    model = MODELS.get(int(data[0, 1205]))
    if model is None:
        known = ", ".join(f"{m.name} ({number:#x})" for number, m in MODELS.items())
        raise UnusableCloudsError(
            f"packets of Velodyne model {int(data[0, 1205]):#x}; known are {known}: decode them "
            "with velodyne_pointcloud's transform_node"
        )
    return model


def _azimuths(blocks: Any, model: Model) -> tuple[Array, Array]:
    """Degrees (P, B, 32) of each shot, turned on from the block's first, and their time (B, 32).

    Times are microseconds after the first shot of the packet.
    """
    start = (blocks[:, :, 2] + blocks[:, :, 3].astype(np.uint16) * 256).astype(np.float64) * 0.01
    turned = np.mod(np.diff(start, axis=1), 360.0)
    turned = np.concatenate([turned, turned[:, -1:]], axis=1)  # of the last block as before it
    shot_us = model.shot_times_us()
    azimuth = start[:, :, None] + turned[:, :, None] * (shot_us / model.block_us)
    offsets = np.tile(model.azimuth_deg, SHOTS // model.lasers)
    within_us = np.arange(blocks.shape[1])[:, None] * model.block_us + shot_us
    return azimuth + offsets, within_us


def _points(ranges: Array, azimuth_deg: Array, model: Model) -> Array:
    """Points (P, B, 32, 3): x forward at azimuth 0, y left, z up."""
    repeats = SHOTS // model.lasers
    elevation = np.radians(np.tile(model.elevation_deg, repeats))
    height = np.tile(model.height_m, repeats)
    azimuth = np.radians(azimuth_deg)
    level = ranges * np.cos(elevation)
    return np.stack(
        [
            level * np.cos(azimuth),
            -level * np.sin(azimuth),
            ranges * np.sin(elevation) + height,
        ],
        axis=-1,
    )


def _packet_times_s(packets: Any, data: Any, stamp_ns: int, packet_us: float) -> Array:
    """Seconds (P,) after the stamp at which the first shot of each packet was fired.

    The packets' own clock counts between them. Drivers stamp a cloud with its first or its last
    packet: that one anchors the clock.
    """
    own_us: IntArray = (
        data[:, 1200:1204].astype(np.int64) @ np.array([1, 2**8, 2**16, 2**24], np.int64)
    ).astype(np.int64)
    stamps_ns = np.array([p.stamp.sec * 10**9 + p.stamp.nanosec for p in packets], np.int64)
    anchor = int(np.abs(stamps_ns - stamp_ns).argmin())
    after_us = (own_us - own_us[anchor] + _HOUR_US // 2) % _HOUR_US - _HOUR_US // 2
    at_ns = int(stamps_ns[anchor])
    off_us = (at_ns // 1000 - int(own_us[anchor])) % _HOUR_US
    received = min(off_us, _HOUR_US - off_us) > _OWN_CLOCK_US
    first_ns = at_ns - stamp_ns - (round(packet_us * 1000) if received else 0)
    return np.asarray(first_ns / NANOSECONDS_PER_SECOND + after_us * 1e-6)
