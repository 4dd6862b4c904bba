"""Copies and parts of a recording have marks in common; other drives have none."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.fusion.marks import MARKS_OF_TOPIC, are_one, drive_marks, marked_drives
from caliv_graph.fusion.terms import drive_digest
from caliv_graph.products import GivenPoses, GnssFixes, ImuSamples, MotionData


def recorded(seed: int = 1, count: int = 1700) -> MotionData:
    rng = np.random.default_rng(seed)
    imu = ImuSamples(
        np.arange(count) * 10_000_000, rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    )
    few = count // 10
    place = rng.normal(scale=1e-6, size=(3, few)) + np.array([[48.0], [11.0], [500.0]])
    gnss = GnssFixes(np.arange(few) * 100_000_000, *place)
    return MotionData(f"drive {seed}", imu=imu, gnss=gnss)


def imu_of(motion: MotionData, part: slice) -> ImuSamples:
    imu = motion.imu
    assert imu is not None
    return ImuSamples(imu.stamps_ns[part], imu.angular_velocity[part], imu.specific_force[part])


@pytest.mark.parametrize(
    "changed",
    [
        lambda m: replace(m, name="copy"),
        lambda m: replace(m, gnss=None),
        lambda m: replace(m, imu=None),
        lambda m: replace(m, imu=imu_of(m, slice(800, None))),
        lambda m: replace(m, imu=imu_of(m, slice(None, None, 4))),
    ],
    ids=["the same", "without gnss", "without imu", "half of it", "thinned"],
)
def test_a_copy_is_known(changed: Callable[[MotionData], MotionData]) -> None:
    motion = recorded()
    copy = changed(motion)
    assert are_one(frozenset(drive_marks(motion)), frozenset(drive_marks(copy)))


def test_another_drive_at_the_same_times_is_another() -> None:
    first, second = (frozenset(drive_marks(recorded(seed))) for seed in (1, 2))
    assert len(first) == 2 * MARKS_OF_TOPIC
    assert not first & second


def test_exact_poses_that_start_at_one_place_are_of_two_drives() -> None:
    """As in a simulation without noise, or the frame numbers of a CaLiV folder."""

    def poses(turn: float) -> MotionData:
        made = tuple(
            gtsam.Pose3(gtsam.Rot3.Yaw(turn * k), np.array([0.2 * k, 0.0, 0.0])) for k in range(99)
        )
        return MotionData("drive", poses=GivenPoses(np.arange(99) * 100_000_000, made))

    assert drive_marks(poses(0.01)) == drive_marks(poses(0.01))
    first, second = (frozenset(drive_marks(poses(turn))) for turn in (0.01, -0.01))
    assert not are_one(first, second)


def test_marks_are_the_smallest_hashes_of_all_messages() -> None:
    """However many of them are hashed at a time."""
    motion = recorded(count=3000)
    imu = motion.imu
    assert imu is not None
    rows = np.hstack([imu.angular_velocity, imu.specific_force])
    hashes = [
        "m" + hashlib.blake2b(row.tobytes(), digest_size=6, key=b"%d" % stamp).hexdigest()
        for stamp, row in zip(imu.stamps_ns.tolist(), rows, strict=True)
    ]
    assert drive_marks(replace(motion, gnss=None)) == tuple(sorted(hashes)[:MARKS_OF_TOPIC])


def test_a_drive_without_motion_data_has_no_marks() -> None:
    assert drive_marks(MotionData("drive")) == ()


def test_the_marks_of_all_that_a_result_was_made_of() -> None:
    of_a = {"drive_sha256": ["a"], "drive_marks": [["m1", "m2"]]}
    of_b = {"drive_sha256": ["b", "c"], "drive_marks": [["m3"], ["m4"]], "prior": of_a}
    found = marked_drives({"drive_sha256": ["a", "b", "c"], "merged": [of_b], "mode": "auto"})
    assert {key: sorted(of) for key, of in found.items()} == {
        "a": ["m1", "m2"],
        "b": ["m3"],
        "c": ["m4"],
    }
    assert drive_digest(recorded()) not in found
