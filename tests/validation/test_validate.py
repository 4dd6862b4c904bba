from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.errors import ConfigError
from caliv_graph.products import Calibration, PoseNoise
from caliv_graph.validation.covariances import given_pose_covariance
from caliv_graph.validation.findings import AFTER, BEFORE, BEST, Validation, Verdict
from caliv_graph.validation.measure import Errors
from caliv_graph.validation.surfaces import Pole, Wall
from caliv_graph.validation.validate import moved_to_neighbours, validate
from caliv_graph.validation.verdict import is_irregular, judge
from tests.drives_with_chair import Memory
from tests.validation.scenes import (
    BOX_XY,
    GUESSES,
    MOUNTINGS,
    POLE_RADIUS_M,
    POLE_XY,
    Scene,
    calibration_of,
    make_config,
    make_recording,
)

WRONG = {"front": (0.0, 0.0, math.radians(1.0), 0.05, 0.0, 0.0)}
"""One degree and 50 mm."""


def validated(
    calibration: Calibration | None = None,
    recording: Memory | None = None,
    config: Config | None = None,
) -> Validation:
    return validate(
        recording or make_recording(),
        calibration or calibration_of(),
        config or make_config(),
        SilentProgress(),
    )


@pytest.fixture(scope="module")
def right() -> Validation:
    return validated()


@pytest.fixture(scope="module")
def wrong() -> Validation:
    return validated(calibration_of(WRONG))


def test_stamps_move_to_their_neighbours() -> None:
    moved = moved_to_neighbours(np.array([0, 90, 200, 310]), np.array([100, 300]), 20)

    assert moved.tolist() == [0, 100, 200, 300]
    assert moved_to_neighbours(np.array([0, 90]), np.array([], np.int64), 20).tolist() == [0, 90]


def test_what_stands_around_is_found(right: Validation) -> None:
    walls = [s.surface for s in right.surfaces if isinstance(s.surface, Wall)]
    poles = [s.surface for s in right.surfaces if isinstance(s.surface, Pole)]

    east = next(wall for wall in walls if abs(wall.normal[0]) > 0.9)
    north = next(wall for wall in walls if wall is not east)
    assert len(walls) == 2
    assert east.centre[0] == pytest.approx(22.0, abs=0.01)
    assert abs(north.normal[0] / north.normal[1]) == pytest.approx(0.1, abs=0.003)
    (pole,) = poles
    assert pole.foot == pytest.approx(POLE_XY, abs=0.01)
    assert pole.radius_m == pytest.approx(POLE_RADIUS_M, abs=0.01)
    (thing,) = right.things
    assert thing.thing.centre[:2] == pytest.approx(BOX_XY, abs=0.1)
    assert thing.thing.extent_m == pytest.approx(0.7, abs=0.15)


def test_a_right_calibration_is_better_than_the_guess_and_explained(right: Validation) -> None:
    (pair,) = right.pairs

    assert pair.lidars == ("front", "rear")
    assert pair.surfaces == 3
    # Guesses are off by degrees: at 20 m that is most of a metre.
    assert 0.2 < pair.distance_m[BEFORE] < 1.5
    assert pair.distance_m[AFTER] < 0.008
    assert right.verdict.better is not None
    assert right.verdict.better > 30.0
    assert not right.verdict.contradicts
    assert right.verdict.p_value is not None
    assert right.verdict.p_value > 0.01
    assert right.verdict.of_expected is not None
    assert 0.1 < right.verdict.of_expected < 2.0
    # Walls as thick as the noise of the ranges, and no thicker.
    assert right.thickness_m[AFTER] == pytest.approx(right.expected_thickness_m, rel=0.15)
    assert right.thickness_m[AFTER] < 0.011
    for name in MOUNTINGS:
        assert right.alone_m[AFTER][name] == pytest.approx(right.expected_alone_m[name], rel=0.2)
    assert pair.cloud_m[AFTER] == pytest.approx(0.0, abs=0.015)


def test_one_degree_and_50_mm_are_seen(right: Validation, wrong: Validation) -> None:
    ((good,), (bad,)) = right.pairs, wrong.pairs

    # 17 mrad over 10 to 20 m and 50 mm, on walls and a pole.
    assert 0.08 < bad.distance_m[AFTER] < 0.5
    assert bad.distance_m[AFTER] > 20.0 * good.distance_m[AFTER]
    assert wrong.verdict.contradicts
    assert "do not explain" in " ".join(wrong.verdict.sentences)
    # The structure is the same, and would be aligned as well.
    assert bad.distance_m[BEST] == pytest.approx(good.distance_m[BEST], abs=0.002)
    assert bad.distance_m[BEFORE] == pytest.approx(good.distance_m[BEFORE], rel=0.1)
    # The LiDAR that is right is not blamed.
    assert wrong.alone_m[AFTER]["rear"] < 0.012 < 0.05 < wrong.alone_m[AFTER]["front"]


def test_a_lidar_whose_own_walls_are_thick_is_not_called_good(
    right: Validation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where one wall alone is shared, a degree of yaw hardly moves its mean distance."""
    monkeypatch.setattr(
        "caliv_graph.validation.verdict.offset_covariance",
        lambda tested, errors: np.eye(right.verdict.dof),
    )
    nothing = Errors(np.zeros((0, 0)), np.zeros((0, 0)), 0.01)

    def verdict(factor: float) -> Verdict:
        front = factor * right.expected_alone_m["front"]
        alone = {**right.alone_m, AFTER: {**right.alone_m[AFTER], "front": front}}
        measured = (right.surfaces, right.things, right.pairs)
        return judge(*measured, (alone, right.expected_alone_m), nothing, right.before)

    assert verdict(1.9).word == "good"
    assert verdict(2.1).word == "unclear"
    assert (
        "By 'front' alone walls and poles are more than twice as thick"
        in (verdict(2.1).sentences[-1])
    )


def test_a_surface_that_is_thick_at_the_best_alignment_tests_nothing(right: Validation) -> None:
    """The corner of a parked car, of which one LiDAR sees a few points."""
    (wall, *others) = right.surfaces
    best = wall.thickness[BEST]
    thick = replace(best, alone={**best.alone, "front": 2.1 * wall.expected.alone["front"]})
    irregular = replace(wall, thickness={**wall.thickness, BEST: thick})
    assert not is_irregular(wall, "front")
    assert is_irregular(irregular, "front")
    assert not is_irregular(irregular, "rear")
    errors = Errors(np.zeros((12, 12)), np.zeros((6 * sum(right.scans.values()),) * 2), 0.01)
    alone = (right.alone_m, right.expected_alone_m)
    measured = ((irregular, *others), right.things, right.pairs)
    assert judge(*measured, alone, errors, right.before).dof == right.verdict.dof - 1


def test_an_error_that_all_lidars_share_is_seen() -> None:
    # All turned by a degree about the vehicle's origin: to each other they are as they were.
    yaw = math.radians(1.0)
    together = {
        name: (0.0, 0.0, yaw, -yaw * xyz[1], yaw * xyz[0], 0.0)
        for name, (xyz, _) in MOUNTINGS.items()
    }
    found = validated(calibration_of(together))

    assert found.verdict.contradicts
    for name in MOUNTINGS:
        assert found.alone_m[AFTER][name] > 2.0 * found.expected_alone_m[name]


def test_a_calibration_that_is_worse_than_the_guess_is_said_to_be() -> None:
    found = validated(calibration_of(WRONG), config=make_config(MOUNTINGS))

    assert found.verdict.better is not None
    assert found.verdict.better < 0.1
    assert found.verdict.word == "worse"
    assert "WORSE" in found.verdict.sentences[0]


def test_nothing_stands_around() -> None:
    found = validated(recording=make_recording(Scene(walls=False, pole=False, box=False)))

    assert not found.has_structure
    assert found.verdict.better is None
    assert found.verdict.p_value is None
    assert "Nothing can be said" in found.verdict.sentences[0]


def test_an_object_alone_is_measured_but_not_judged() -> None:
    found = validated(recording=make_recording(Scene(walls=False, pole=False)))

    (thing,) = found.things
    apart = {stage: thing.distance_m[stage]["front", "rear"] for stage in (BEFORE, AFTER)}
    assert apart[BEFORE] > 3.0 * apart[AFTER]
    assert found.verdict.better is None
    assert "not known" in found.verdict.sentences[0]


def test_ground_counts_only_if_the_solve_did_without() -> None:
    recording = make_recording(Scene(walls=False, pole=False, box=False))
    found = validated(recording=recording, config=make_config(ground=False))

    assert [s.name for s in found.surfaces] == ["ground 1"]
    (ground,) = found.surfaces
    assert ground.apart[AFTER]["front", "rear"].distance_m < 0.01
    assert ground.apart[BEFORE]["front", "rear"].distance_m > 0.1


def test_the_target_is_left_out() -> None:
    x, y = BOX_XY
    region = TargetRegion(min=(x - 0.5, y - 0.5, -0.5), max=(x + 0.5, y + 0.5, 1.5))
    found = validated(config=make_config(region=region))

    assert found.things == ()
    assert found.clouds.target_points > 100


def test_late_stamps_are_put_right_by_the_calibration() -> None:
    # At 2.7 m/s and 0.3 rad/s, 50 ms are 140 mm and 15 mrad.
    recording = make_recording(late_s={"front": 0.05})
    told = validated(calibration_of(offsets={"front": (0.05, 1e-4)}), recording)
    untold = validated(recording=recording)

    assert told.pairs[0].distance_m[AFTER] < 0.008
    assert not told.verdict.contradicts
    assert untold.pairs[0].distance_m[AFTER] > 0.03
    assert untold.verdict.contradicts


def test_order_and_names_of_the_lidars_change_nothing(right: Validation) -> None:
    config = make_config({name: GUESSES[name] for name in ("rear", "front")})
    found = validated(config=config)

    (pair,) = found.pairs
    assert pair.lidars == ("rear", "front")
    assert pair.distance_m[AFTER] == pytest.approx(right.pairs[0].distance_m[AFTER], abs=1e-3)
    assert found.verdict.chi2 == pytest.approx(right.verdict.chi2, abs=1.5)


def test_other_lidars_are_refused() -> None:
    config = make_config()
    strangers = {f"roof_{name}": lidar for name, lidar in config.lidars.items()}
    config = config.model_copy(update={"lidars": strangers, "reference": "roof_front"})

    with pytest.raises(ConfigError, match=r"none of the LiDARs .* \(front, rear\), but roof_front"):
        validated(config=config)


def test_a_lidar_that_was_not_calibrated_is_left_out() -> None:
    calibration = calibration_of()
    calibration = replace(
        calibration,
        lidars={"front": calibration.lidars["front"]},
        cov_joint=calibration.cov_joint[:6, :6],
    )
    config = make_config()
    nobody = config.lidars["rear"].model_copy(update={"initial": None})
    lidars = {**config.lidars, "rear": nobody}
    found = validated(calibration, config=config.model_copy(update={"lidars": lidars}))

    assert found.lidars == ("front",)
    assert found.warnings[0] == "LiDAR 'rear' is not in the calibration: left out"
    assert found.pairs == ()
    assert found.verdict.measure == "thickness"
    assert found.verdict.p_value is None
    assert "Each alone" in found.verdict.sentences[0]


def test_given_poses_err_together() -> None:
    noise = PoseNoise(1e-3, 2e-3, 3e-3, 4e-3, 4.0)
    cov = given_pose_covariance(np.array([0, 4_000_000_000]), noise)

    assert cov[0, 0] == pytest.approx(1e-6 + 9e-6)
    assert cov[5, 5] == pytest.approx(4e-6 + 16e-6)
    # A correlation time later, 1/e of the slow part is left, and nothing of the white one.
    assert cov[5, 11] == pytest.approx(16e-6 / math.e)
    assert cov[0, 5] == cov[0, 7] == 0.0
