"""Times of points against the time from cloud to cloud: what a sweep can take, and what not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caliv_graph.config.lidars import LidarConfig, StampSetting
from caliv_graph.config.model import TopicsConfig
from caliv_graph.readers.cloud_folder import CloudFolder
from caliv_graph.readers.pointcloud2 import DecodedCloud, TimeField
from caliv_graph.readers.rosbag import RosbagRecording
from caliv_graph.readers.sweeps import TimesSeen, mark_of_clouds, untimed_warning
from tests.readers.bags import SECOND, START, cloud, write_bag

COUNT = 50
PART = np.arange(COUNT) / COUNT
"""Of the sweep, at each point."""

POINTS = 5.0 * np.stack([np.cos(6.28 * PART), np.sin(6.28 * PART), 0.1 * PART], axis=1)

LIDARS = {"top": LidarConfig(topic="/top")}


def recorded(
    folder: Path,
    period_s: float,
    times: np.ndarray,
    field: tuple[str, str],
    delay_s: float,
    kept: list[int] | None = None,
) -> RosbagRecording:
    """A bag of clouds that have one sweep each; `kept` are the numbers of those not dropped."""
    messages = []
    for k in kept or range(20):
        stamp = START + round(k * period_s * SECOND)
        late_ns = round(delay_s * SECOND) + 1_000_000 * (k % 3)
        messages.append(("/top", stamp + late_ns, cloud(stamp, POINTS, times, field)))
    path = write_bag(folder / "drive", messages)
    return RosbagRecording(path, LIDARS, TopicsConfig())


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("delay_s", [0.003, 0.105, 0.8])
@pytest.mark.parametrize("field", [("time", "f4"), ("t", "f8")])
def test_times_that_are_a_part_of_the_sweep_are_not_taken_for_seconds(
    tmp_path: Path, period_s: float, delay_s: float, field: tuple[str, str]
) -> None:
    recording = recorded(tmp_path, period_s, PART, field, delay_s)

    assert all(scan.point_times_s is None for scan in recording.scans("top"))

    mark = recording.stamp_mark("top")
    assert (mark.marks, mark.told_by, mark.shift_s, mark.note) == ("start", "", 0.0, "")
    (line,) = recording.warnings()
    assert "the times of the points of 20 clouds are not used: field " in line
    assert f"spans 0.98 s in a cloud, and a cloud comes every {period_s:g} s" in line
    assert "convert the field" in line


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize(
    "kept",
    [
        None,
        [k for k in range(40) if k % 3],  # every third is dropped
        [*range(0, 60, 3), 61, 62],  # two of three are
        [0, 1, 2, 30, 31, 32, 33, 70, 71, 72],  # long gaps
    ],
)
@pytest.mark.parametrize("part", [0.3, 1.0, 1.2])  # a narrow view; a turn; sweeps that overlap
def test_sweeps_of_slow_and_fast_lidars_keep_their_times(
    tmp_path: Path, period_s: float, kept: list[int] | None, part: float
) -> None:
    times_s = part * period_s * PART
    recording = recorded(tmp_path, period_s, times_s, ("time", "f8"), 1.1 * part * period_s, kept)

    for scan in recording.scans("top"):
        assert scan.point_times_s is not None
        np.testing.assert_allclose(scan.point_times_s, times_s, atol=1e-12)

    assert recording.stamp_mark("top").told_by == "records"
    assert recording.warnings() == []


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("unit_ns", [1_000, 1_000_000])
def test_times_in_another_unit_are_warned_about(
    tmp_path: Path, period_s: float, unit_ns: int
) -> None:
    times = (PART * period_s * SECOND / unit_ns).astype(np.uint32)
    recording = recorded(tmp_path, period_s, times, ("t", "u4"), 1.1 * period_s)

    list(recording.scans("top"))

    (line,) = recording.warnings()
    assert "field 't' (uint32), read as ns after the stamp, spans" in line
    assert f"a cloud comes every {period_s:g} s" in line
    assert "in another unit" in line
    # The same in nanoseconds is right.
    (tmp_path / "right").mkdir()
    right = recorded(tmp_path / "right", period_s, times * unit_ns, ("t", "u4"), 1.1 * period_s)
    list(right.scans("top"))
    assert right.warnings() == []


def test_clouds_that_come_rarely_may_have_short_sweeps(tmp_path: Path) -> None:
    recording = recorded(tmp_path, 30.0, 0.1 * PART, ("time", "f8"), 0.11)

    list(recording.scans("top"))

    assert recording.warnings() == []


def clouds(*spans_s: float) -> list[DecodedCloud]:
    field = TimeField("time", "float32", "s after the stamp")
    return [DecodedCloud(POINTS, span_s * PART, field) for span_s in spans_s]


@pytest.mark.parametrize(
    ("spans_s", "believed"),
    [
        ((0.1, 0.1, 0.9), True),  # sweeps that were held back, in one message
        ((0.2, 0.2, 0.2), True),  # two sweeps in each
        ((0.1, 0.9, 0.9), False),
        ((0.3, 0.3), False),
    ],
)
@pytest.mark.parametrize("setting", ["auto", "start", "end"])
def test_the_median_cloud_tells(
    spans_s: tuple[float, ...], believed: bool, setting: StampSetting
) -> None:
    delays_s = np.array([0.001, 0.002])

    mark = mark_of_clouds(setting, clouds(*spans_s), delays_s, 0.1)

    assert (mark.time_problem == "") is believed
    if not believed:
        assert (mark.shift_s, mark.note) == (0.0, "")
        assert mark.marks == ("end" if setting == "end" else "start")
    # Of a single cloud nobody knows the time to the next.
    assert mark_of_clouds(setting, clouds(*spans_s), delays_s, None).time_problem == ""


def test_clouds_in_files(tmp_path: Path) -> None:
    kinds = ("x f4", "y f4", "z f4", "time f4")
    table = np.zeros(COUNT, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")])
    table["x"], table["y"], table["z"] = POINTS.T
    table["time"] = PART
    (tmp_path / "top").mkdir()
    for k in range(3):
        table.tofile(tmp_path / "top" / f"{START + k * SECOND // 10}.bin")
    lidar = LidarConfig(topic="top", bin_fields=kinds, stamp="end")

    recording = CloudFolder(tmp_path, {"top": lidar})

    assert all(scan.point_times_s is None for scan in recording.scans("top"))
    (line,) = [line for line in recording.warnings() if "LiDAR 'top'" in line]
    assert "are not used: field 'time' (float32)" in line


def test_a_lidar_without_times_beside_one_that_has_them_is_named() -> None:
    timed = TimesSeen(TimeField("t", "float32", "seconds"), 0.0, 0.1, 20, span_s=0.1)
    flash, none = TimesSeen(timed.field, clouds=20), TimesSeen()
    (line,) = untimed_warning("bag", {"top": timed, "left": none, "right": none})
    assert line.startswith("bag: points of 'left' and 'right' have no times, those of 'top' have.")
    # Nor those that are not used, as of another unit.
    unused = TimesSeen(problems=20, problem="in another unit")
    (line,) = untimed_warning("bag", {"top": timed, "left": unused})
    assert line.startswith("bag: points of 'left' have no times, those of 'top' have.")
    for of in (
        {"top": timed, "left": flash},
        {"top": none, "left": none},
        {"top": flash, "a": none},
    ):
        assert untimed_warning("bag", of) == []
