"""What the checks of a solution find, and what remains once the first suspect is named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.check import strains, unexplained
from caliv_graph.calibration.vehicle_parameters import KEYS
from caliv_graph.conventions import key_vehicle
from caliv_graph.products import Solution, Suspect
from caliv_graph.trajectory.factors import Gaussian
from caliv_graph.trajectory.parameters import LEVER_ARM
from caliv_graph.uncertainty.consistency import Heading

TURNED = Heading("drive", 0.04, 0.002, told_apart=True)


@pytest.mark.parametrize(
    ("first", "left"),
    [
        ("gnss.drift", ()),
        ("imu.yaw_bias", ()),
        ("lidars.front.initial", (TURNED,)),
        ("ground.vehicle_height", (TURNED,)),
    ],
)
def test_a_heading_is_no_finding_of_its_own_where_the_motion_is_wrong(
    first: str, left: tuple[Heading, ...]
) -> None:
    suspect = Suspect(first, (1.0,), (0.1,), (1.0,), ("m",), 0.9, 65.0, 65.0)
    assert unexplained([TURNED], [suspect]) == left


def test_strains_are_those_of_the_poses_of_each_drive() -> None:
    """Two poses of one drive, the second 3 sigmas off along each axis; one of another, 2 off."""
    sigma = np.array([1e-3] * 3 + [0.01] * 3)
    poses = [gtsam.Pose3.Expmap(np.full(6, 0.1 * i)) for i in range(3)]
    arm = np.array([0.1, 0.2, 0.3])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    keys = (key_vehicle(0), key_vehicle(1), KEYS[LEVER_ARM.name])
    H = np.diag(np.concatenate([sigma**-2.0, sigma**-2.0, np.full(3, 1e4)]))
    graph.add(Gaussian(keys, (*poses[:2], arm), H, np.zeros(15)).factor())
    graph.add(gtsam.PriorFactorVector(KEYS[LEVER_ARM.name], arm, gtsam.noiseModel.Unit.Create(3)))
    graph.add(Gaussian((key_vehicle(2),), (poses[2],), np.diag(sigma**-2.0), np.zeros(6)).factor())
    values.insert(key_vehicle(0), poses[0])
    values.insert(key_vehicle(1), poses[1].retract(3.0 * sigma))
    values.insert(key_vehicle(2), poses[2].retract(2.0 * sigma))
    values.insert(KEYS[LEVER_ARM.name], arm)
    solution = SimpleNamespace(
        graph=graph,
        values=values,
        factor_kinds=("motion", "vehicle_parameter", "motion"),
        T_map_vehicle={(0, 10): None, (0, 20): None, (1, 10): None},
    )
    first, second = strains(cast(Solution, solution), ["morning", "noon"])
    assert (first.drive, first.coordinates) == ("morning", 12)
    assert first.chi_square == pytest.approx(54.0, rel=1e-3)
    assert (second.drive, second.coordinates) == ("noon", 6)
    assert second.sigmas == pytest.approx(2.0, rel=1e-3)
