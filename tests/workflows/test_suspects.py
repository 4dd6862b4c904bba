"""What a second run with the first suspect freed changes in the config."""

from __future__ import annotations

from pathlib import Path

import pytest

from caliv_graph.config.load import parse_config
from caliv_graph.products import Suspect
from caliv_graph.workflows.suspects import Trial, trial_of
from tests.samples import make_calibration

CONFIG = parse_config(
    {
        "lidars": {
            "front": {"topic": "/front", "initial": {"xyz": [2, 0, 2]}},
            "rear": {"topic": "/rear", "initial": {"xyz": [-0.4, 0, 2]}},
        },
        "gnss": {"lever_arm": [1.0, 0.3, 0.9]},
        "ground": {"vehicle_height": 0.1},
    },
    "test",
    Path(),
)


def tried(
    name: str,
    value: tuple[float, ...],
    sigma: tuple[float, ...],
    sigmas: float = 9.0,
    determined: tuple[bool, ...] = (),
) -> Trial | None:
    units: tuple[str, ...] = ("m",) * 3 + ("deg",) * 3
    units = units[: len(value)]
    suspect = Suspect(name, value, sigma, value, units, 0.9, sigmas, sigmas, determined)
    return trial_of(make_calibration("front", "rear", suspects=(suspect,)), CONFIG)


def test_a_lever_arm_takes_what_the_drive_tells_and_stays_uncertain() -> None:
    told = (True, True, False)
    trial = tried("gnss.lever_arm", (1.2, 0.31, 0.9), (0.02, 0.02, 9.0), determined=told)
    assert trial is not None
    assert trial.config.gnss.lever_arm == (1.2, 0.31, 0.9)  # the height is as it was typed
    assert trial.config.gnss.arm_sigma() == 2.0
    assert "gnss.lever_arm: [1.2, 0.31, 0.9]" in trial.change


def test_every_lidar_clock_is_freed_by_time_offset() -> None:
    for name in ("lidars.rear.time_offset", "lidars.*.time_offset"):
        trial = tried(name, (0.1,), (0.005,))
        assert trial is not None
        assert trial.config.solve.time_offset
        assert trial.change == "solve.time_offset: true"


def test_a_height_is_set_with_its_sigma() -> None:
    trial = tried("ground.vehicle_height", (0.3,), (0.04,))
    assert trial is not None
    assert (trial.config.ground.vehicle_height, trial.config.ground.sigma) == (0.3, 0.04)


def test_a_guess_is_set_where_the_data_have_it() -> None:
    trial = tried(
        "lidars.rear.initial", (-0.4, 0.8, 2.0, 0.0, 10.0, 165.0), (0.06,) * 3 + (2.0,) * 3
    )
    assert trial is not None
    assert trial.config.lidars["rear"].given.xyz == (-0.4, 0.8, 2.0)
    assert trial.config.lidars["rear"].sigma.rpy_deg == 2.0
    assert trial.config.lidars["front"] == CONFIG.lidars["front"]


@pytest.mark.parametrize(
    ("name", "sigmas"), [("lidars.rear.mount.halves", 9.0), ("gnss.lever_arm", 4.9)]
)
def test_nothing_is_tried_without_a_key_or_below_five_sigma(name: str, sigmas: float) -> None:
    assert tried(name, (0.1, 0.0, 0.0), (0.01,) * 3, sigmas) is None
