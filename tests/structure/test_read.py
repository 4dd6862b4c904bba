"""Which scans of a drive are read, and that their patches lie on the walls."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray, LidarScan, Trajectory
from caliv_graph.structure.patches import DrivePatches, RangeNoise
from caliv_graph.structure.read import (
    MAX_POSES,
    MAX_SCANS,
    MIN_SCANS,
    chosen_scans,
    read_patches,
    scan_patches,
)
from caliv_graph.trajectory.select import GivenTrajectory
from tests.drives_with_chair import Memory
from tests.samples import pose
from tests.structure.worlds import Spinner, World, driven, recorded, yard
from tests.trajectory.motions import eight_drive

NOISE = RangeNoise.constant(0.01)

TRAJECTORY = driven(eight_drive())
SPINNERS = {
    "front": Spinner(pose((2.0, 0.0, 2.0), (0.0, 10.0, 0.0)), np.linspace(-12.5, 12.5, 60)),
    "top": Spinner(
        pose((0.5, 0.1, 2.3), (2.0, -3.0, 70.0)),
        np.linspace(-20.0, 12.0, 32),
        np.linspace(-180.0, 180.0, 600, endpoint=False),
        sweep_s=0.1,
    ),
}
CONFIG = Config(
    lidars={
        name: LidarConfig(
            topic=name,
            initial=PoseConfig(
                xyz=tuple(s.T_vehicle_lidar.translation()),
                rpy_deg=tuple(np.degrees(s.T_vehicle_lidar.rotation().rpy())),
            ),
        )
        for name, s in SPINNERS.items()
    }
)
SECOND_NS = 1_000_000_000


def standing(seconds: float) -> GivenTrajectory:
    stamps = np.arange(0.0, seconds, 0.1) * SECOND_NS
    return GivenTrajectory(Trajectory(stamps.astype(np.int64), (gtsam.Pose3(),) * len(stamps)))


def every(period_s: float, trajectory: GivenTrajectory, late_s: float = 0.0) -> IntArray:
    begin, end = trajectory.span_ns
    late = round(late_s * SECOND_NS)
    return np.arange(begin + late, end, round(period_s * SECOND_NS), dtype=np.int64)


def distances(patches: DrivePatches, world: World) -> tuple[Array, Array]:
    """From each patch to the nearest surface of its direction; and its sine to that surface."""
    R, t = TRAJECTORY.poses_at(
        patches.stamps_ns[patches.scan] + np.round(1e9 * patches.time_s).astype(np.int64)
    )
    extrinsics = [SPINNERS[name].T_vehicle_lidar for name in patches.lidars]
    R_extrinsic, t_extrinsic = (a[patches.scan_lidar[patches.scan]] for a in stack(extrinsics))
    centre = np.einsum("nij,nj->ni", R_extrinsic, patches.centres_lidar) + t_extrinsic
    centre = np.einsum("nij,nj->ni", R, centre) + t
    normal = np.einsum("nij,njk,nk->ni", R, R_extrinsic, patches.normal_lidar)
    n = np.cross(world.first, world.second)
    n /= np.linalg.norm(n, axis=1)[:, None]
    off = np.abs(centre @ n.T - np.einsum("ki,ki->k", world.corner, n))
    sine = np.sqrt(np.clip(1.0 - (normal @ n.T) ** 2, 0.0, None))
    off[sine > 0.3] = np.inf
    nearest = off.argmin(axis=1)
    rows = np.arange(len(off))
    return off[rows, nearest], sine[rows, nearest]


def test_patches_of_a_drive_lie_on_its_walls_each_at_its_own_time() -> None:
    stamps = {"front": every(4.0, TRAJECTORY, 1.0), "top": every(4.0, TRAJECTORY, 1.04)}
    recording = recorded(yard(), TRAJECTORY, SPINNERS, stamps)
    (patches,) = read_patches([recording], [TRAJECTORY], CONFIG, SilentProgress())
    assert patches.lidars == ("front", "top")
    assert (np.diff(patches.scan) >= 0).all()
    assert (np.diff(patches.scan_lidar) >= 0).all()
    assert patches.without_rows == frozenset()
    for k, name in enumerate(patches.lidars):
        own = patches.stamps_ns[patches.scan_lidar == k]
        assert set(own.tolist()) <= set(stamps[name].tolist())
        assert len(own) >= len(stamps[name]) - 1
    of_top = patches.scan_lidar[patches.scan] == 1
    assert (patches.time_s[~of_top] == 0.0).all()
    assert patches.time_s[of_top].min() < 0.02
    assert patches.time_s[of_top].max() > 0.08
    # The turn moves points at 20 m by 0.4 m within a sweep.
    off, sine = distances(patches, yard())
    for part in (of_top, ~of_top):
        assert part.sum() > 500
        assert np.median(off[part]) < 0.002
        assert np.quantile(off[part], 0.99) < 0.01
        assert np.quantile(sine[part], 0.99) < 0.07
    up = np.einsum("nij,nj->ni", stack([s.T_vehicle_lidar for s in SPINNERS.values()])[0][
        patches.scan_lidar[patches.scan]], patches.normal_lidar)[:, 2]  # fmt: skip
    assert np.abs(up).max() < 0.5
    (both,) = read_patches([recording], [TRAJECTORY], CONFIG, SilentProgress(), keep_level=True)
    assert len(both.scan) > 1.2 * len(patches.scan)
    assert distances(both, yard())[0].max() < 0.05


def test_a_long_drive_gives_as_many_scans_as_a_short_one_spread_over_its_way() -> None:
    fast, slow = every(0.1, TRAJECTORY), every(0.25, TRAJECTORY, 0.03)
    chosen = chosen_scans([fast, slow, []], TRAJECTORY)
    assert MAX_SCANS - 10 < len(chosen[0]) <= MAX_SCANS
    assert len(chosen[1]) <= MAX_SCANS
    assert set(chosen[1].tolist()) <= set(slow.tolist())
    assert len(chosen[2]) == 0
    _, t = TRAJECTORY.poses_at(chosen[0])
    steps = np.linalg.norm(np.diff(t, axis=0), axis=1)
    assert np.quantile(steps, 0.95) < 1.5 * np.median(steps)


def test_the_stamps_of_many_lidars_together_are_bounded() -> None:
    eight = [every(0.1, TRAJECTORY, 0.0125 * i) for i in range(8)]
    apart = chosen_scans(eight, TRAJECTORY)
    assert MAX_POSES - 16 < len(np.unique(np.concatenate(apart))) <= MAX_POSES
    assert {len(own) for own in apart} <= {MAX_POSES // 8, MAX_POSES // 8 - 1}
    # The vehicle drives on at the same instants: each LiDAR sees all of the way.
    assert np.ptp(apart[0]) > 0.95 * np.ptp(eight[0])
    for two in ([eight[0], eight[4]], [eight[0]] * 8):
        assert all(MAX_SCANS - 10 < len(own) <= MAX_SCANS for own in chosen_scans(two, TRAJECTORY))


def test_a_vehicle_that_stands_gives_few_scans_but_some() -> None:
    assert len(chosen_scans([every(0.1, standing(5.0))], standing(5.0))[0]) == MIN_SCANS
    assert len(chosen_scans([every(0.1, standing(60.0))], standing(60.0))[0]) == 59
    assert len(chosen_scans([every(0.1, standing(900.0))], standing(900.0))[0]) == MAX_SCANS
    (few,) = chosen_scans([[10, SECOND_NS, 80 * SECOND_NS]], standing(60.0))
    assert few.tolist() == [10, SECOND_NS]


@dataclass
class Counting:
    """A recording that makes its scans when they are asked for."""

    trajectory: GivenTrajectory
    spinner: Spinner
    made: list[int] = field(default_factory=list)
    name: str = "counting"

    def scan_stamps_ns(self, lidar: str) -> list[int]:
        return [int(s) for s in every(0.1, self.trajectory)]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        rng = np.random.default_rng(0)
        for stamp in self.scan_stamps_ns(lidar):
            if wanted is None or stamp in wanted:
                self.made.append(stamp)
                yield self.spinner.scan(lidar, yard(), self.trajectory, stamp, rng)


def test_no_scan_is_decoded_that_is_not_needed_and_none_twice() -> None:
    small = Spinner(
        pose((2.0, 0.0, 2.0), (0.0, 0.0, 0.0)), np.arange(-5.0, 5.0), np.arange(-30.0, 30.0)
    )
    recording = Counting(TRAJECTORY, small)
    config = CONFIG.model_copy(update={"lidars": {"front": CONFIG.lidars["front"]}})
    (patches,) = read_patches([recording], [TRAJECTORY], config, SilentProgress())  # type: ignore[list-item]
    assert len(recording.made) == len(set(recording.made)) == len(patches.stamps_ns) <= MAX_SCANS


def test_a_drive_without_scans_has_no_patches() -> None:
    begin, _ = TRAJECTORY.span_ns
    early = LidarScan("front", begin - SECOND_NS, np.ones((3, 3)), "early")
    recording = Memory({"front": (early,), "top": ()}, recorded(yard(), TRAJECTORY, {}, {}).poses)
    (patches,) = read_patches([recording], [TRAJECTORY], CONFIG, SilentProgress())
    assert len(patches.scan) == len(patches.stamps_ns) == 0
    assert patches.moments.shape == (0, 4, 4)
    assert patches.centres_lidar.shape == (0, 3)


def test_a_time_that_no_sweep_has_is_an_error() -> None:
    scan = LidarScan("front", SECOND_NS, np.ones((2, 3)), "a scan", np.array([0.0, 1e9]))
    with pytest.raises(TrajectoryError, match="a scan: per-point times"):
        scan_patches(scan, gtsam.Pose3(), TRAJECTORY, NOISE)


def test_patches_from_outside_the_trajectory_are_left_out() -> None:
    spinner = SPINNERS["top"]
    _, end = TRAJECTORY.span_ns
    longer = driven(eight_drive(62.0))
    scan = spinner.scan("top", yard(), longer, end - 50_000_000, np.random.default_rng(0))
    patches = scan_patches(scan, spinner.T_vehicle_lidar, TRAJECTORY, NOISE, keep_level=True)
    assert len(patches.time_s) > 20
    assert 0.03 < patches.time_s.max() <= 0.05
