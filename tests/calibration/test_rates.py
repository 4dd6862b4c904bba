"""What the gyroscope turned between the stamp of a cloud and its points."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.linear import linearise_clouds
from caliv_graph.calibration.rates import turned_clouds
from caliv_graph.conventions import key_vehicle
from tests.calibration.problems import make_case, predictions


def test_a_cloud_turns_as_the_vehicle_does_between_its_stamp_and_its_points() -> None:
    case = make_case(count=4)
    sigmas = np.zeros((8, 3))
    sigmas[5] = [1e-4, 2e-4, 3e-4]  # the cloud of the second LiDAR at pose 1
    sigmas[2] = [3e-4, 1e-4, 1e-4]
    problem = replace(case.problem, cloud_turn_rad=sigmas)

    columns = turned_clouds(problem, linearise_clouds(problem, case.truth))

    assert columns.shape == (48, 6)
    assert not columns[6 * np.array([0, 1, 3, 4, 6, 7])[:, None] + np.arange(6)].any()
    for k, (j, i) in enumerate(((2, 2), (5, 1))):
        for axis in range(3):
            turn = np.zeros(6)
            turn[axis] = sigmas[j, axis]
            values = gtsam.Values(case.truth)
            key = key_vehicle(i)
            values.update(key, values.atPose3(key).compose(gtsam.Pose3.Expmap(turn)))
            after = predictions(problem, values)[j]
            change = gtsam.Pose3.Logmap(after.compose(case.measured[j].inverse()))
            own = columns[6 * j : 6 * j + 6, 3 * k + axis]
            assert change == pytest.approx(own, abs=1e-6)


def test_clouds_of_an_instant_do_not_turn() -> None:
    case = make_case(count=2)

    assert turned_clouds(case.problem, linearise_clouds(case.problem, case.truth)).shape == (24, 0)
