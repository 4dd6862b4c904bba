"""Covariances of the registration, on a few clouds."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.scenario.model import load_scenario
from scripts.show_sandwich import Scene, grouped, reported, run, table

SCENARIO = Path(__file__).parents[2] / "configs" / "scenarios" / "figure_eight.yaml"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(load_scenario(SCENARIO), 6)


def test_scores_add_up_and_sigmas_are_of_the_error_s_size(scene: Scene) -> None:
    # `run` raises unless the clouds' scores add up to the gradient of `quadratic`.
    options = argparse.Namespace(points=120, components=100)
    of_runs = [run(scene, "still", seed, options) for seed in (0, 1)]
    names, rows = reported(scene.truth)
    assert len(names) == len(rows) == 11
    for one in of_runs:
        claimed = np.sqrt(np.diag(rows @ one.claimed @ rows.T))
        assert (np.abs(rows @ one.error) < 8.0 * claimed).all()
        sandwich = np.sqrt(np.diag(rows @ one.sandwich @ rows.T))
        assert (sandwich > 0.1 * claimed).all()
        assert (sandwich < 5.0 * claimed).all()
    assert of_runs[0].profile is not None
    lines = list(table("still", of_runs, names, rows))
    assert lines[2].startswith("S2S roll")


def test_clouds_of_one_place_are_one_group(scene: Scene) -> None:
    clouds = scene.draw("still", 0, 120)
    places = len(set(zip(clouds.lidar.tolist(), clouds.order.tolist(), strict=True)))
    assert places < len(clouds.lidar)
    assert len(grouped(np.ones((len(clouds.lidar), 12)), clouds, 1)) == places
