"""Heights and tilts of all guesses against the ground together: by hand, and what is to blame."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.targets.ground.guesses import (
    HEIGHT_FLOOR_M,
    LidarGround,
    Misfit,
    _sigma_of_median,
    misfits,
)
from caliv_graph.wording.physics import guess_findings

SIGMA_M, GROUND_M = 0.058, 0.005


def config(heights: dict[str, float], vehicle_height: float | None = 0.5) -> Config:
    """LiDARs above the vehicle's origin, so that its tilt lifts none."""
    lidars = {
        name: {"topic": name, "initial": {"xyz": [0, 0, z]}, "sigma": {"xyz": SIGMA_M}}
        for name, z in heights.items()
    }
    ground = {"vehicle_height": vehicle_height, "sigma": GROUND_M}
    return parse_config({"lidars": lidars, "ground": ground}, "made up", Path())


def seen(name: str, height_m: float, roll_deg: float = 0.0) -> LidarGround:
    return LidarGround(name, height_m, np.radians([roll_deg, 0.0]), 8)


def of(quantity: str, found: tuple[Misfit, ...]) -> Misfit:
    return next(misfit for misfit in found if misfit.quantity == quantity)


def test_what_all_lidars_have_in_common_is_the_vehicle_height() -> None:
    # Both are 0.3 m lower than their guesses and the vehicle's height say.
    guessed = config({"front": 2.0, "rear": 1.5})
    grounds = [seen("front", 2.2), seen("rear", 1.7)]

    found = of("height", misfits(grounds, guessed))

    own = SIGMA_M**2 + HEIGHT_FLOOR_M**2
    sigma = math.sqrt(own / 2.0 + GROUND_M**2)
    assert (found.lidar, found.dof) == ("", 2)
    assert found.value == pytest.approx(-0.3)
    assert found.sigma == pytest.approx(sigma)
    assert found.sigmas == pytest.approx(0.3 / sigma)
    assert found.chi2 == pytest.approx((0.3 / sigma) ** 2)
    (finding,) = guess_findings("drive", misfits(grounds, guessed), guessed)
    assert (finding.input, finding.severity) == ("ground.vehicle_height", "contradiction")
    assert finding.value == pytest.approx((0.2,))
    assert "vehicle_height 0.20 +- 0.04 m would fit" in finding.sentence
    assert "or z of all guesses, -0.30 m" in finding.sentence


def test_what_one_lidar_has_alone_is_its_guess() -> None:
    guessed = config({"front": 2.0, "rear": 1.5, "left": 1.0})
    grounds = [seen("front", 2.5), seen("rear", 2.0), seen("left", 1.9)]

    found = of("height", misfits(grounds, guessed))

    assert found.lidar == "left"
    # Freed, it is where its own measurement puts it, given that the others fit.
    assert found.value == pytest.approx(0.4, abs=0.01)
    (finding,) = guess_findings("drive", misfits(grounds, guessed), guessed)
    assert finding.input == "lidars.left.initial.xyz"
    assert finding.value == pytest.approx((1.4,), abs=0.01)


def test_heights_and_tilts_that_differ_from_scan_to_scan_are_the_terrains() -> None:
    """Eight scans of hills: the median of their heights is no better than their spread allows."""
    guessed = config({"front": 2.0, "rear": 1.5})
    level = [seen("front", 2.8, 5.0), seen("rear", 2.3, 5.0)]
    hilly = [
        replace(g, height_sigma_m=0.4, roll_pitch_sigma_rad=np.radians([10.0, 10.0])) for g in level
    ]
    for quantity, sigma in (("height", 0.4), ("roll", math.radians(10.0))):
        sure, unsure = (of(quantity, misfits(grounds, guessed)) for grounds in (level, hilly))
        # Of what both have in common, and half of what each has alone.
        assert unsure.sigma == pytest.approx(math.hypot(sure.sigma, sigma * 1.5**0.5), rel=1e-6)
    assert of("height", misfits(level, guessed)).sigmas > 5.0
    assert guess_findings("drive", misfits(hilly, guessed), guessed) == ()
    # Nor is one of them to blame.
    apart = [hilly[0], replace(hilly[1], height_m=1.505)]
    assert guess_findings("drive", misfits(apart, guessed), guessed) == ()


def test_the_spread_of_scans_tells_how_well_their_median_is_known() -> None:
    rng = np.random.default_rng(4)
    sigmas = [_sigma_of_median(rng.normal(0.0, [0.1, 0.02], (8, 2))) for _ in range(400)]
    medians = [np.median(rng.normal(0.0, [0.1, 0.02], (8, 2)), axis=0) for _ in range(400)]
    assert np.mean(sigmas, axis=0) == pytest.approx(np.std(medians, axis=0), rel=0.15)


def test_guesses_that_are_inverse_are_said_beside_the_height() -> None:
    grounds = [seen("front", 2.3), seen("rear", 2.4)]
    guessed = config({"front": -1.8, "rear": -1.9})
    (finding,) = guess_findings("drive", misfits(grounds, guessed), guessed)
    assert finding.input == "ground.vehicle_height"
    assert "with the other sign z fits as well. Check that guesses" in finding.sentence


@pytest.mark.parametrize("height_m", [1.05, 3.0])
def test_a_wrong_vehicle_height_is_no_inverse(height_m: float) -> None:
    guessed = config({"front": 0.35, "rear": 0.3}, vehicle_height=1.7)
    grounds = [seen("front", 0.35 + height_m), seen("rear", 0.3 + height_m)]
    (finding,) = guess_findings("drive", misfits(grounds, guessed), guessed)
    assert finding.input == "ground.vehicle_height"
    assert "other sign" not in finding.sentence


def test_guesses_within_their_sigmas_are_no_finding() -> None:
    # The corners of uniform errors of +-0.1 m, whose sigma is 0.058 m.
    for errors in ((0.1, 0.1), (0.1, -0.1), (-0.1, -0.1)):
        guessed = config({"front": 2.0, "rear": 1.5})
        grounds = [seen("front", 2.5 + errors[0]), seen("rear", 2.0 + errors[1])]
        assert guess_findings("drive", misfits(grounds, guessed), guessed) == ()


def test_without_a_vehicle_height_none_is_tested() -> None:
    found = misfits([seen("front", 9.0)], config({"front": 2.0}, vehicle_height=None))
    assert {misfit.quantity for misfit in found} == {"roll", "pitch"}
    assert misfits([], config({"front": 2.0})) == ()


def test_a_guess_that_is_turned_is_named_with_what_would_be_level() -> None:
    guessed = config({"front": 2.0, "rear": 1.5})
    grounds = [seen("front", 2.5, roll_deg=12.0), seen("rear", 2.0, roll_deg=0.5)]

    found = guess_findings("drive", misfits(grounds, guessed), guessed)

    (finding,) = found
    assert (finding.input, finding.severity) == (
        "lidars.front.initial.rpy_deg",
        "contradiction",
    )
    assert finding.value[0] == pytest.approx(-12.0, abs=0.2)
    assert "'front' sees is not level: roll by +1" in finding.sentence
