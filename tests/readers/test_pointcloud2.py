from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.readers.bag import DamagedMessageError
from caliv_graph.readers.pointcloud2 import (
    DecodedCloud,
    TimeField,
    UnusableCloudsError,
    decode_livox,
    decode_pointcloud2,
)
from tests.readers.bags import (
    SECOND,
    START,
    Message,
    as_object,
    cloud,
    livox,
    packed_cloud,
    serialise,
)

FAR = 1e6
STAMP = START + 123_456_789
POINTS = np.array([[1.5, 2.0, 3.0], [4.0, -5.0, 6.25], [7.0, 8.0, -9.0], [0.5, 0.0, 0.25]])


def decode(message: Message, stamp_ns: int = STAMP, low: float = 0.0) -> DecodedCloud:
    return decode_pointcloud2(as_object(message), stamp_ns, low, FAR)


def times_of(found: DecodedCloud) -> Array:
    assert found.times_s is not None
    return found.times_s


@pytest.mark.parametrize("order", list(itertools.permutations(["x", "y", "z", "t", "i"]))[::7])
def test_any_order_of_fields(order: tuple[str, ...]) -> None:
    columns: dict[str, tuple[Any, str]] = {
        "x": (POINTS[:, 0], "f4"),
        "y": (POINTS[:, 1], "f8"),
        "z": (POINTS[:, 2], "f4"),
        "t": (np.array([0, 1000, 2000, 3000]), "u4"),
        "i": (np.arange(4), "u1"),
    }

    found = decode(packed_cloud(STAMP, {name: columns[name] for name in order}))

    np.testing.assert_array_equal(found.points_lidar, POINTS)
    np.testing.assert_allclose(times_of(found), [0, 1e-6, 2e-6, 3e-6], atol=1e-15)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("height", [1, 2, 4])
@pytest.mark.parametrize("padding", [(0, 0, 0), (4, 0, 0), (0, 3, 0), (1, 2, 5), (0, 0, 16)])
def test_endianness_rows_and_padding(
    big_endian: bool, height: int, padding: tuple[int, int, int]
) -> None:
    columns: dict[str, tuple[Any, str]] = {
        "x": (POINTS[:, 0], "f4"),
        "y": (POINTS[:, 1], "f4"),
        "z": (POINTS[:, 2], "f4"),
        "timestamp": (STAMP / SECOND + np.array([0, 0.01, 0.02, 0.03]), "f8"),
    }

    message = packed_cloud(STAMP, columns, height, big_endian, padding)
    found = decode(message)

    assert message["height"] == height
    np.testing.assert_array_equal(found.points_lidar, POINTS)
    np.testing.assert_allclose(times_of(found), [0, 0.01, 0.02, 0.03], atol=1e-6)


def test_what_is_no_return_is_dropped_together_with_its_time() -> None:
    points = np.array(
        [
            *([1.0, 0, 0], [0.0, 0, 0], [math.nan, 0, 0], [2.0, 0, 0], [0, 0, math.inf]),
            *([0.4, 0, 0], [0, math.nan, 0], [3.0, 0, 0], [60.0, 0, 0]),
        ]
    )
    # The times of what is no return are garbage, and must not spoil the others.
    times = [10, 4_000_000_000, 4_000_000_000, 20, 30, 40, 50, 60, 70]

    found = decode_pointcloud2(as_object(cloud(STAMP, points, times)), STAMP, 0.5, 50.0)

    np.testing.assert_array_equal(found.points_lidar[:, 0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(times_of(found), [10e-9, 20e-9, 60e-9])


SWEEP = np.array([0.0, 0.025, 0.05, 0.099])

CONVENTIONS: list[tuple[str, str, Any, str, str]] = [
    ("t", "u4", SWEEP * 1e9, "uint32", "ns after the stamp"),
    ("t", "i4", SWEEP * 1e9, "int32", "ns after the stamp"),
    ("time", "f4", SWEEP, "float32", "s after the stamp"),
    ("time", "f8", SWEEP, "float64", "s after the stamp"),
    ("time_offset", "f4", SWEEP, "float32", "s after the stamp"),
    ("time_stamp", "u4", SWEEP * 1e9, "uint32", "ns after the stamp"),
    ("offset_time", "u4", SWEEP * 1e9, "uint32", "ns after the stamp"),
    ("timestamp", "f8", STAMP / 1e9 + SWEEP, "float64", "s, absolute"),
    ("timestamp", "f8", STAMP / 1e6 + SWEEP * 1e3, "float64", "ms, absolute"),
    ("timestamp", "f8", STAMP / 1e3 + SWEEP * 1e6, "float64", "us, absolute"),
    ("timestamp", "f8", STAMP + SWEEP * 1e9, "float64", "ns, absolute"),
    ("timestamp", "f8", SWEEP, "float64", "s after the stamp"),
    ("timestamp", "f4", SWEEP, "float32", "s after the stamp"),
]


@pytest.mark.parametrize(("name", "kind", "values", "type_name", "unit"), CONVENTIONS)
def test_every_convention_of_time(
    name: str, kind: str, values: Any, type_name: str, unit: str
) -> None:
    found = decode(cloud(STAMP, POINTS, values, (name, kind)))

    assert found.time_field == TimeField(name, type_name, unit)
    assert found.time_problem == ""
    # A float64 of nanoseconds since 1970 is good for 256 ns; of seconds, for 240 ns.
    np.testing.assert_allclose(times_of(found), SWEEP, atol=5e-7)


@pytest.mark.parametrize(("kind", "scale"), [("f4", 1.0), ("i4", 1e9)])
def test_stamps_at_the_end_of_the_sweep(kind: str, scale: float) -> None:
    found = decode(cloud(STAMP, POINTS, (SWEEP - 0.1) * scale, ("time", kind)))

    np.testing.assert_allclose(times_of(found), SWEEP - 0.1, atol=1e-8)


def test_an_absolute_time_in_a_simulation_that_began_a_moment_ago() -> None:
    # 0.05 may be 0.05 s after the stamp or at 0.05 s; the name `timestamp` says which.
    values = 0.05 + SWEEP
    stamp = 50_000_000

    found = decode(cloud(stamp, POINTS, values, ("timestamp", "f8")), stamp)

    np.testing.assert_allclose(times_of(found), SWEEP, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "kind", "values", "words"),
    [
        ("time", "f4", SWEEP * 1e6, "field 'time' (float32), read as s after the stamp, spans 0"),
        ("t", "u4", [0, 1, 2, 1_200_000_000], "to 1.2 s from the stamp, more than 1 s"),
        ("timestamp", "f8", STAMP / 1e9 + 37.0 + SWEEP, "spans 37 to 37.1 s"),
        ("time", "f4", SWEEP * 1e3, "In milliseconds it would span 0 to 0.099 s: convert"),
        (
            "t",
            "f4",
            SWEEP * 1e6,
            "In microseconds it would span 0 to 0.099 s: convert the field to",
        ),
        ("timestamp", "f8", SWEEP * 1e9, "In nanoseconds it would span 0 to 0.099 s: convert"),
        ("t", "u1", [0, 1, 2, 3], "is of a type that no known convention has"),
        ("time", "f4", [0.0, math.nan, 0.0, 0.1], "holds values that are not finite"),
    ],
)
def test_times_that_are_not_believed_are_told(
    name: str, kind: str, values: Any, words: str
) -> None:
    found = decode(cloud(STAMP, POINTS, values, (name, kind)))

    assert found.times_s is None
    assert found.time_field is None
    assert words in found.time_problem
    assert len(found.points_lidar) == 4


def test_times_of_another_clock_are_not_in_another_unit() -> None:
    found = decode(cloud(STAMP, POINTS, 123456.0 + SWEEP, ("timestamp", "f8")))

    assert "from the stamp, more than 1 s" in found.time_problem
    assert "convert" not in found.time_problem


def test_the_first_plausible_field_counts() -> None:
    columns: dict[str, tuple[Any, str]] = {
        axis: (POINTS[:, i], "f4") for i, axis in enumerate("xyz")
    }
    columns["time"] = (np.full(4, 1e9), "f4")
    columns["timestamp"] = (STAMP / 1e9 + SWEEP, "f8")

    found = decode(packed_cloud(STAMP, columns))

    assert found.time_field == TimeField("timestamp", "float64", "s, absolute")


def test_clouds_without_times_or_without_points() -> None:
    assert decode(cloud(STAMP, POINTS)).times_s is None
    empty = decode(cloud(STAMP, np.empty((0, 3)), [], ("t", "u4")))
    assert empty.points_lidar.shape == (0, 3)
    assert empty.time_problem == ""


def test_a_row_step_of_zero_in_a_single_row() -> None:
    np.testing.assert_array_equal(decode(cloud(STAMP, POINTS, row_step=0)).points_lidar, POINTS)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"data": np.zeros(47, np.uint8)}, "has 47 bytes of data, expected 48"),
        ({"point_step": 8}, "has point_step 8"),
        ({"height": 2, "width": 2, "row_step": 10}, "row_step 10 bytes"),
    ],
)
def test_a_layout_that_does_not_fit_is_damage(changes: Message, words: str) -> None:
    with pytest.raises(DamagedMessageError, match=words):
        decode(cloud(STAMP, POINTS, **changes))


def test_clouds_without_coordinates() -> None:
    columns: dict[str, tuple[Any, str]] = {
        "range": (POINTS[:, 0], "f4"),
        "x": (POINTS[:, 0], "f4"),
        "y": (POINTS[:, 0], "i2"),
    }
    with pytest.raises(UnusableCloudsError, match="range float32, x float32, y int16"):
        decode(packed_cloud(STAMP, columns))


@pytest.mark.parametrize("frame_id", ["", "a", "livox_frame", "livox_frame_2"])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
@pytest.mark.parametrize(("ros1", "little"), [(False, True), (False, False), (True, True)])
def test_livox_as_rosbags_serialises_it(
    frame_id: str, count: int, ros1: bool, little: bool
) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    offsets = [1000 * k for k in range(count)]

    raw = serialise(livox(STAMP, points, offsets, frame_id), ros1, little)
    found = decode_livox(raw, ros1, STAMP, 0.0, FAR)

    np.testing.assert_array_equal(found.points_lidar, points)
    if count:
        np.testing.assert_allclose(times_of(found), np.array(offsets) * 1e-9)
        assert found.time_field == TimeField("offset_time", "uint32", "ns after the stamp")


def test_livox_zero_returns_and_damage() -> None:
    raw = serialise(livox(STAMP, [[0, 0, 0], [1, 0, 0], [9, 0, 0]], [10, 20, 30]))

    found = decode_livox(raw, False, STAMP, 0.5, 5.0)

    np.testing.assert_array_equal(found.points_lidar, [[1, 0, 0]])
    np.testing.assert_allclose(times_of(found), [20e-9])
    for part in (raw[:10], raw[:40], raw[:-10], raw + bytes(40)):
        with pytest.raises(DamagedMessageError):
            decode_livox(part, False, STAMP, 0.0, FAR)


def test_a_damaged_size_makes_no_room_for_its_points() -> None:
    """2^32 by 2^32 points: more memory than there is, and more than 64 bits of it."""
    for width, height in ((2**32 - 1, 2**32 - 1), (2**31, 1), (1, 2**31)):
        message = cloud(STAMP, POINTS) | {"width": width, "height": height, "row_step": 2**32 - 1}
        with pytest.raises(DamagedMessageError):
            decode(message)
