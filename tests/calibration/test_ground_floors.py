"""What scans of one place share of the ground's waves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration import estimate
from caliv_graph.calibration.ground_floors import (
    bends_of_ground,
    disc_overlap,
    sharing_scans,
    with_floors,
)
from caliv_graph.calibration.sensor_noise import SensorNoise
from caliv_graph.calibration.structure_evidence import StructureEvidence
from caliv_graph.common.progress import SilentProgress
from caliv_graph.errors import SolveError
from caliv_graph.products import Array, GroundObservation
from caliv_graph.targets.ground.planes import RADII_M
from caliv_graph.trajectory.select import VehicleTrajectory
from tests.calibration.test_structure import config_of

DIAMETER_M = 2.0 * RADII_M[-1]


def axes(*headings_deg: float) -> Array:
    """(N, 2, 3) level axes, turned."""
    out = []
    for heading in np.radians(headings_deg):
        c, s = np.cos(heading), np.sin(heading)
        out.append([[c, s, 0.0], [-s, c, 0.0]])
    return np.array(out)


def test_a_vehicle_that_stands_sees_one_plane() -> None:
    assert sharing_scans(axes(*[30.0] * 7), np.zeros((7, 3))) == pytest.approx(np.full((7, 3), 7))


def test_scans_a_disc_apart_share_nothing() -> None:
    places = DIAMETER_M * np.arange(4)[:, None] * np.array([1.0, 0.0, 0.0])
    assert sharing_scans(axes(*[0.0] * 4), places) == pytest.approx(np.ones((4, 3)))


def test_a_turn_tells_the_tilt_of_the_ground_from_the_lidar_s_but_no_height() -> None:
    """A right angle on the spot: two tilts that share nothing, one height."""
    assert sharing_scans(axes(0.0, 90.0), np.zeros((2, 3))) == pytest.approx(
        np.array([[1.0, 1.0, 2.0], [1.0, 1.0, 2.0]])
    )


def test_a_full_turn_averages_the_tilt_out() -> None:
    sharing = sharing_scans(axes(*range(0, 360, 30)), np.zeros((12, 3)))
    assert sharing == pytest.approx(np.tile([1.0, 1.0, 12.0], (12, 1)))


def test_overlap_of_discs() -> None:
    """At half a diameter: two segments of 120 degrees, 2/3 - sqrt(3) / (2 pi) of the disc."""
    assert disc_overlap(np.array([0.0, 0.5, 1.0, 3.0])) == pytest.approx(
        [1.0, 2 / 3 - np.sqrt(3.0) / (2.0 * np.pi), 0.0, 0.0]
    )


class Driving:
    """A vehicle that drives ahead at 3 m/s."""

    def poses_at(self, stamps_ns: list[int]) -> tuple[Array, Array]:
        count = len(stamps_ns)
        return np.tile(np.eye(3), (count, 1, 1)), np.outer(3e-9 * np.array(stamps_ns), [1, 0, 0])


def seen_from(*places: tuple[str, int]) -> list[GroundObservation]:
    """Level ground, by the LiDAR and the time."""
    return [
        GroundObservation(
            lidar=lidar,
            drive=0,
            stamp_ns=stamp_ns,
            normal_lidar=np.array([0.0, 0.0, 1.0]),
            distance_m=1.5,
            axes_lidar=np.eye(2, 3),
            cov=np.diag([2e-6, 2e-6, 9e-6]),
            centre_lidar=np.array([2.0, 0.0, -1.5]),
            points=500,
        )
        for lidar, stamp_ns in places
    ]


def test_other_floors_in_observations() -> None:
    """The floor of single scans changes, and what they share is beside it."""
    observations = seen_from(("front", 0), ("front", 0), ("rear", 0), ("front", 10**11))
    before, after = np.array([1e-3, 1e-3, 2e-3]), np.array([2e-3, 2e-3, 1e-3])
    places = {name: gtsam.Pose3() for name in ("front", "rear")}

    changed = with_floors(
        observations, [cast("VehicleTrajectory", Driving())], places, before, after
    )

    for o in changed:
        assert o.cov == pytest.approx(np.diag([5e-6, 5e-6, 6e-6]))
    # Twice from one place; once by another LiDAR; once 300 m away.
    for o, shares in zip(changed, (1.0, 1.0, 0.0, 0.0), strict=True):
        assert o.repeated == pytest.approx(shares * after**2)


def test_axes_of_level_ground_jump_and_the_ground_does_not() -> None:
    """A hair decides which of two axes is the first."""
    floors = np.array([1e-3, 1e-3, 3e-3])
    bend = np.array([3e-3, -1e-3, 1e-2])
    level = [replace(o, beyond=bend) for o in seen_from(*[("front", 0)] * 5)]
    level[2] = replace(
        level[2], axes_lidar=level[2].axes_lidar[::-1] * [[1.0], [-1.0]], beyond=bend[[1, 0, 2]]
    )

    found = with_floors(
        level, [cast("VehicleTrajectory", Driving())], {"front": gtsam.Pose3()}, floors, floors
    )

    for o in found:
        assert o.cov == pytest.approx(level[0].cov)
        assert o.repeated == pytest.approx(4.0 * (floors**2 + o.beyond**2))


def test_what_bends_the_ground_is_the_mean_of_its_place_less_noise() -> None:
    rng = np.random.default_rng(5)
    alike, here = np.tile(np.eye(2), (400, 1, 1)), np.zeros((400, 3))
    noise, ground = rng.normal(0.0, 1e-3, (400, 3)), rng.normal(0.0, 4e-3, (400, 3))
    variances = np.full((400, 3), 1e-6)

    # The mean square of 400 is known to 7 percent.
    assert bends_of_ground(noise, variances, alike, here).max() < 0.2e-6
    both = bends_of_ground(noise + ground, variances, alike, here)
    assert both == pytest.approx(np.full((400, 3), 16e-6), rel=0.25)

    # A bend elsewhere is no evidence here.
    apart = here.copy()
    apart[200:, 0] = 3.0 * DIAMETER_M
    noise[200:] += ground[200:]
    found = bends_of_ground(noise, variances, alike, apart)
    assert found[:200].max() < 0.3e-6
    assert found[200:] == pytest.approx(np.full((200, 3), 16e-6), rel=0.25)


def test_a_bend_of_the_guess_is_not_of_the_ground() -> None:
    """What a scan was compensated with bends level ground; a better extrinsic takes that away."""
    floors = np.array([1e-3, 1e-3, 3e-3])
    guess, found = gtsam.Rot3.RzRyRx(0.02, -0.03, 0.01), gtsam.Rot3.RzRyRx(0.01, 0.0, 0.0)
    w = gtsam.Rot3.Logmap(guess.between(found))
    by_extrinsic = np.array([[0.0, 0.01, 0.0], [0.02, 0.0, 0.0], [0.0, 0.03, 0.0]])
    seen = [
        replace(
            o,
            R_vehicle_lidar=guess.matrix(),
            beyond=-by_extrinsic @ w,
            beyond_by_extrinsic=by_extrinsic,
            cov=o.cov + np.outer(by_extrinsic @ w, by_extrinsic @ w),
        )
        for o in seen_from(("front", 0), ("front", 0))
    ]
    place = {"front": gtsam.Pose3(found, np.zeros(3))}
    driving = [cast("VehicleTrajectory", Driving())]

    changed = with_floors(seen, driving, place, floors, floors)
    again = with_floors(changed, driving, place, floors, floors)

    for o in (*changed, *again):
        assert o.beyond == pytest.approx(0.0, abs=1e-12)
        assert o.cov == pytest.approx(seen_from(("front", 0))[0].cov)
        assert o.repeated == pytest.approx(floors**2)


def test_scans_of_one_place_share_waves_without_a_target_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two LiDARs' planes and no target: n scans of one place are no n independent ones."""
    taken: list[GroundObservation] = []

    def solve(*arguments: Any) -> None:
        taken.extend(arguments[3])
        raise SolveError("far enough")

    floors = np.array([1e-3, 1e-3, 3e-3])
    driving = cast("VehicleTrajectory", Driving())
    monkeypatch.setattr(estimate, "noise_of_motion", lambda *_: SensorNoise(0.01, floors))
    monkeypatch.setattr(estimate, "with_noise", lambda *_: (driving,))
    monkeypatch.setattr(estimate, "solve_structure_and_ground", solve)
    patches: Any = (object(),)
    structure = StructureEvidence(patches)
    grounds = seen_from(("front", 0), ("front", 0), ("rear", 0))

    with pytest.raises(SolveError, match="far enough"):
        estimate.estimate_with_noise(
            [], [driving], config_of("front", "rear"), SilentProgress(), grounds, structure
        )

    for o, shares in zip(taken, (1.0, 1.0, 0.0), strict=True):
        assert o.repeated == pytest.approx(shares * floors**2)
