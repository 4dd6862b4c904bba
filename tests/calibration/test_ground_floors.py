"""What scans of one place share of the ground's waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration import estimate
from caliv_graph.calibration.ground_floors import (
    bends_of_ground,
    disc_overlap,
    overlap_of_discs,
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
    assert sharing_scans(axes(*[30.0] * 7), overlap_of_discs(np.zeros((7, 3)))) == pytest.approx(
        np.full((7, 3), 7)
    )


def test_scans_a_disc_apart_share_nothing() -> None:
    places = DIAMETER_M * np.arange(4)[:, None] * np.array([1.0, 0.0, 0.0])
    assert sharing_scans(axes(*[0.0] * 4), overlap_of_discs(places)) == pytest.approx(
        np.ones((4, 3))
    )


def test_a_turn_tells_the_tilt_of_the_ground_from_the_lidar_s_but_no_height() -> None:
    """A right angle on the spot: two tilts that share nothing, one height."""
    assert sharing_scans(axes(0.0, 90.0), overlap_of_discs(np.zeros((2, 3)))) == pytest.approx(
        np.array([[1.0, 1.0, 2.0], [1.0, 1.0, 2.0]])
    )


def test_a_full_turn_averages_the_tilt_out() -> None:
    sharing = sharing_scans(axes(*range(0, 360, 30)), overlap_of_discs(np.zeros((12, 3))))
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
        assert o.repeated == pytest.approx(np.diag(shares * after**2))


def bent_by(bend: Array, o: GroundObservation, axes_lidar: Array) -> GroundObservation:
    """An observation whose patch bends, as it is measured."""
    by_bend = np.outer(bend, bend)
    return replace(o, beyond=bend, by_bend=by_bend, cov=o.cov + by_bend, axes_lidar=axes_lidar)


def test_axes_of_level_ground_jump_and_the_ground_does_not() -> None:
    """Which axis is the first depends on a normal that is level to a hair."""
    floors, level = np.array([1e-3, 1e-3, 3e-3]), np.eye(2, 3)
    jumped = level[::-1] * np.array([[1.0], [-1.0]])
    seen = [
        bent_by(np.array([3e-3, -1e-3, 1e-2]), o, level) for o in seen_from(*[("front", 0)] * 5)
    ]
    seen[2] = bent_by(np.array([-1e-3, -3e-3, 1e-2]), seen_from(("front", 0))[0], jumped)
    driving = [cast("VehicleTrajectory", Driving())]

    found = with_floors(seen, driving, {"front": gtsam.Pose3()}, floors, floors)

    for before, after in zip(seen, found, strict=True):
        assert after.cov == pytest.approx(before.cov)
        assert after.repeated == pytest.approx(4.0 * (np.diag(floors**2) + before.by_bend))


def test_a_scan_that_seems_flat_where_others_are_bent_counts_as_they_do() -> None:
    floors, bend = np.array([1e-3, 1e-3, 3e-3]), np.array([3e-3, -1e-3, 1e-2])
    seen = [bent_by(bend, o, np.eye(2, 3)) for o in seen_from(*[("front", 0)] * 5)]
    seen[2] = bent_by(np.zeros(3), seen_from(("front", 0))[0], np.eye(2, 3))
    noisy = [replace(o, beyond_variances=0.1 * bend**2) for o in seen]
    driving, place = [cast("VehicleTrajectory", Driving())], {"front": gtsam.Pose3()}

    found = with_floors(noisy, driving, place, floors, floors)

    by_bend = (0.8 - 0.1) * np.outer(bend, bend)
    for o in found:
        assert o.cov == pytest.approx(seen_from(("front", 0))[0].cov + by_bend)
        assert o.repeated == pytest.approx(4.0 * (np.diag(floors**2) + by_bend))
    again = with_floors(found, driving, place, floors, floors)
    for one, other in zip(found, again, strict=True):
        assert one.cov == pytest.approx(other.cov)
        assert one.repeated == pytest.approx(other.repeated)


def test_what_bends_the_ground_is_the_mean_of_its_place_less_noise() -> None:
    rng = np.random.default_rng(5)
    alike, here = np.tile(np.eye(2), (400, 1, 1)), np.zeros((400, 3))
    noise, ground = rng.normal(0.0, 1e-3, (400, 3)), rng.normal(0.0, 4e-3, (400, 3))
    variances = np.full((400, 3), 1e-6)

    # The mean square of 400 is known to 7 percent.
    assert np.abs(bends_of_ground(noise, variances, alike, overlap_of_discs(here))).max() < 0.2e-6
    both = bends_of_ground(noise + ground, variances, alike, overlap_of_discs(here))
    assert both == pytest.approx(np.tile(16e-6 * np.eye(3), (400, 1, 1)), abs=4e-6)

    # A bend elsewhere is no evidence here, nor is a scan that hardly tells its own.
    apart = here.copy()
    apart[200:, 0] = 3.0 * DIAMETER_M
    noise[200:] += ground[200:]
    noise[0], variances[0] = 0.5, 0.3**2
    noise[399], variances[399] = 1e-2, 0.3**2
    found = bends_of_ground(noise, variances, alike, overlap_of_discs(apart))
    assert np.abs(found[:200]).max() < 0.3e-6
    assert found[200:] == pytest.approx(np.tile(16e-6 * np.eye(3), (200, 1, 1)), abs=4e-6)
    assert (np.linalg.eigvalsh(found) > -1e-12).all()


def test_one_bend_in_axes_of_each_scan() -> None:
    bend, none, here = np.array([3e-3, -1e-3, 1e-2]), np.full((3, 3), 1e-12), np.zeros((3, 3))
    turned = np.array([gtsam.Rot2(a).matrix() for a in (0.0, 0.6, -np.pi / 2.0)])
    seen = np.column_stack([turned @ bend[:2], np.full(3, bend[2])])

    found = bends_of_ground(seen, none, turned, overlap_of_discs(here))

    assert found == pytest.approx(np.einsum("na,nb->nab", seen, seen), abs=1e-10)


def test_a_bend_of_the_guess_is_not_of_the_ground() -> None:
    """What a scan was compensated with bends level ground; a better extrinsic takes that away."""
    floors = np.array([1e-3, 1e-3, 3e-3])
    guess, true = gtsam.Rot3.RzRyRx(0.02, -0.03, 0.01), gtsam.Rot3.RzRyRx(0.01, 0.0, 0.0)
    w = gtsam.Rot3.Logmap(guess.between(true))
    by_extrinsic = np.array([[0.0, 0.01, 0.0], [0.02, 0.0, 0.0], [0.0, 0.03, 0.0]])
    seen = [
        replace(
            bent_by(-by_extrinsic @ w, o, np.eye(2, 3)),
            R_vehicle_lidar=guess.matrix(),
            beyond_by_extrinsic=by_extrinsic,
        )
        for o in seen_from(("front", 0), ("front", 0))
    ]
    driving = [cast("VehicleTrajectory", Driving())]

    def at(of: Sequence[GroundObservation], R: gtsam.Rot3) -> tuple[GroundObservation, ...]:
        return with_floors(of, driving, {"front": gtsam.Pose3(R, np.zeros(3))}, floors, floors)

    # An extrinsic that is far off first, as a rough solve may have it.
    for found in (at(seen, true), at(at(seen, guess), true), at(at(seen, true), true)):
        for o in found:
            assert o.cov == pytest.approx(seen_from(("front", 0))[0].cov, abs=1e-12)
            assert o.repeated == pytest.approx(np.diag(floors**2), abs=1e-12)


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
        assert o.repeated == pytest.approx(np.diag(shares * floors**2))
