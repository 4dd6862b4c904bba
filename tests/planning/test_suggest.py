"""Suggestions: good enough, in the least space, and drivable."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from caliv_graph.errors import ConfigError, TargetError
from caliv_graph.planning import Assumptions, predict
from caliv_graph.planning.predict import space
from caliv_graph.planning.suggest import (
    CLEAR_M,
    candidates,
    is_met,
    parse_goals,
    shortfall,
    suggest,
)
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import Scenario, dump_scenario, load_scenario, parse_scenario
from tests.scan_rates import scanned_at

SCENARIOS = Path(__file__).resolve().parents[2] / "configs" / "scenarios"

BY_PLANES = Assumptions(structure=False)
"""Ground by planes, as in the quick predictions of a search; cell by cell, as the first test has
it, a prediction takes ten times as long."""


def scenario(name: str = "paper_arc", rate_hz: float = 2.0) -> Scenario:
    """Slowly: what slow errors and the target leave is the same, a prediction is much faster."""
    return scanned_at(load_scenario(SCENARIOS / f"{name}.yaml"), rate_hz)


def area(found: Scenario) -> float:
    x, y = space([(found, make_drive(found.drive))])
    return x * y


def test_what_is_suggested_is_good_enough() -> None:
    goals = {"s2v_yaw_deg": 0.05, "s2v_x_m": 0.01}
    arc = predict(scenario())
    assert not is_met(shortfall(arc, goals), goals)

    found = suggest(scenario(), goals, Assumptions())

    assert found is not None
    assert found.met
    assert found.worst <= 1.0
    # By what is predicted of the scenario itself, as a person would look it up.
    again = predict(found.scenario)
    assert max(math.degrees(s[2]) for s in again.sigma_s2v.values()) <= 0.05
    assert max(s[3] for s in again.sigma_s2v.values()) <= 0.01


def test_no_smaller_candidate_is_good_enough() -> None:
    goals = {"s2v_yaw_deg": 0.02, "s2s_x_m": 0.004}

    found = suggest(scenario(), goals, BY_PLANES)

    assert found is not None
    assert found.met
    smaller = [s for _, s in candidates(scenario()) if area(s) < 0.99 * area(found.scenario)]
    assert smaller
    # The largest first: those that are nearly good enough are among them.
    for other in sorted(smaller, key=area)[::-4]:
        with contextlib.suppress(TargetError):
            assert not is_met(shortfall(predict(other, assumptions=BY_PLANES), goals), goals)


def test_without_goals_nothing_is_to_stay_open() -> None:
    found = suggest(scenario(), {}, BY_PLANES)

    assert found is not None
    assert found.met
    assert found.prediction.undetermined == ()
    assert "S-curve" in found.manoeuvre


def test_a_ramp_where_the_ground_tells_no_height() -> None:
    # As many scans as it takes on the ramp.
    found = suggest(scenario(rate_hz=4.0), {"s2v_z_m": 0.02}, replace(BY_PLANES, ground="plane"))

    assert found is not None
    assert found.met
    assert "over a ramp" in found.manoeuvre
    assert len(found.scenario.world.ground.ramps) == 1


def test_what_cannot_be_had_is_not_promised() -> None:
    goals = {"s2v_yaw_deg": 1e-5}

    found = suggest(scenario(), goals, BY_PLANES)

    assert found is not None
    assert not found.met
    assert found.worst > 1.0
    assert found.worst == pytest.approx(shortfall(found.prediction, goals))


def test_a_vehicle_that_stood_gets_something_to_drive() -> None:
    found = suggest(scenario("static"), {}, BY_PLANES)

    assert found is not None
    assert found.met
    assert found.prediction.covariance.unseeing == ()


def test_candidates_leave_room_to_get_past_and_can_be_simulated() -> None:
    for _, candidate in candidates(scenario("tri_lidar"), with_ramp=True):
        drive = make_drive(candidate.drive)
        stamps = np.linspace(0.0, drive.duration_s * 1e9, 500).astype(np.int64)
        place = np.array(candidate.world.objects["chair"].xy_m)
        clear = np.linalg.norm(drive.motion(stamps).xy_map - place, axis=1).min()
        assert clear > CLEAR_M - 0.2
        # A file of it is a scenario again.
    assert parse_scenario(yaml.safe_load(dump_scenario(candidate)), "x") == candidate


def test_the_vehicle_keeps_its_turning_radius_and_its_lidars() -> None:
    base = scenario("tri_lidar")
    for _, candidate in candidates(base):
        assert getattr(candidate.drive, "radius_m", None) == 9.16
        assert candidate.lidars == base.lidars


@pytest.mark.parametrize(
    ("items", "message"),
    [
        (["yaw=1"], "expected KEY=VALUE"),
        (["s2v_yaw_deg"], "expected KEY=VALUE"),
        (["s2v_yaw_m=1"], "expected KEY=VALUE"),
        (["s2v_yaw_deg=small"], "'small' is not a number above zero"),
        (["s2v_yaw_deg=-1"], "not a number above zero"),
        (["s2v_yaw_deg=nan"], "not a number above zero"),
        (["s2v_x_m=1", "s2v_x_m=2"], "given twice"),
    ],
)
def test_goals_that_make_no_sense(items: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_goals(items)


def test_goals_are_limits() -> None:
    assert parse_goals(["s2v_yaw_deg=0.05", "s2s_x_m=1e-2"]) == {
        "s2v_yaw_deg": 0.05,
        "s2s_x_m": 0.01,
    }
