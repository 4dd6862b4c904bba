from __future__ import annotations

import io
import json

import gtsam
import numpy as np

from caliv_graph.export.consumers.json import export as export_json
from caliv_graph.export.consumers.npz import export as export_npz
from caliv_graph.export.covariance import ros_covariance
from tests.export.requests import T_VEHICLE_LIDAR, calibration_of, request


def test_ros_covariance_by_monte_carlo() -> None:
    """What perturbed poses do to position and to rotation about fixed axes, as ROS asks for."""
    rng = np.random.default_rng(7)
    calibration = calibration_of()
    cov = calibration.cov_joint
    poses = list(T_VEHICLE_LIDAR.values())
    draws = rng.multivariate_normal(np.zeros(12), cov, size=20_000)
    samples = np.empty_like(draws)
    for row, d in zip(samples, draws, strict=True):
        for i, T in enumerate(poses):
            moved = T.retract(d[6 * i : 6 * i + 6])
            row[6 * i : 6 * i + 3] = moved.translation() - T.translation()
            turned = moved.rotation().compose(T.rotation().inverse())
            row[6 * i + 3 : 6 * i + 6] = gtsam.Rot3.Logmap(turned)
    sampled = np.cov(samples.T)

    stated = ros_covariance(poses, cov)

    # Entries of a sampled covariance are off by sqrt((s_ij^2 + s_ii s_jj) / n).
    variance = (stated**2 + np.outer(np.diag(stated), np.diag(stated))) / len(draws)
    z = (sampled - stated) / np.sqrt(variance)
    assert np.abs(z).max() < 4.5
    # The order matters, and so do the axes: neither may pass by accident.
    for wrong in (cov, ros_covariance([T.inverse() for T in poses], cov)):
        assert np.abs((sampled - wrong) / np.sqrt(variance)).max() > 20.0


def test_npz_needs_neither_pickle_nor_this_project() -> None:
    calibration = calibration_of()

    loaded = np.load(io.BytesIO(export_npz(request(calibration)).content), allow_pickle=False)

    np.testing.assert_array_equal(loaded["covariance_gtsam"], calibration.cov_joint)
    assert list(loaded["order_gtsam"][[0, 3, 6]]) == ["front.rot_x", "front.x", "rear.rot_x"]
    assert list(loaded["order_ros"][[0, 3, 6]]) == ["front.x", "front.rot_x", "rear.x"]
    # The variance of x along the vehicle's x axis is that of the LiDAR's axes, turned.
    R = T_VEHICLE_LIDAR["front"].rotation().matrix()
    turned = R @ calibration.cov_joint[3:6, 3:6] @ R.T
    assert np.isclose(loaded["covariance_ros"][0, 0], turned[0, 0], rtol=1e-12)
    assert "Exp(d)" in str(loaded["side_gtsam"])
    assert "fixed axes of the vehicle" in str(loaded["side_ros"])
    assert loaded["T_vehicle_lidar"].shape == (2, 4, 4)
    np.testing.assert_allclose(loaded["T_vehicle_lidar"][1], T_VEHICLE_LIDAR["rear"].matrix())
    undetermined = loaded["determined_axes"][~loaded["determined"][0]]
    assert sorted(undetermined) == ["x", "yaw"]
    assert "p_parent = T p_child" in str(loaded["comment"])


def test_json_says_the_same() -> None:
    asked = request()
    loaded = np.load(io.BytesIO(export_npz(asked).content))

    document = json.loads(export_json(asked).content)

    for name in ("gtsam", "ros"):
        entry = document[f"covariance_{name}"]
        np.testing.assert_array_equal(entry["matrix"], loaded[f"covariance_{name}"])
        assert entry["order"] == list(loaded[f"order_{name}"])
        assert entry["side"] == str(loaded[f"side_{name}"])
    assert document["lidars"]["front"]["undetermined"] == ["yaw", "x"]
    assert "p_parent = T p_child" in " ".join(document["comment"])


def test_one_lidar_gets_its_marginal() -> None:
    calibration = calibration_of()

    document = json.loads(export_json(request(calibration, lidars=("rear",))).content)

    np.testing.assert_array_equal(
        document["covariance_gtsam"]["matrix"], calibration.cov_joint[6:, 6:]
    )
    assert list(document["lidars"]) == ["rear"]
