from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.errors import ExportError, OutputError
from caliv_graph.fusion.archive import (
    archive_paths,
    serialise,
    write_archive,
    write_calibration_archive,
)
from caliv_graph.fusion.factors import lidar_pose_factor, serialisable
from caliv_graph.fusion.priors import extrinsic_values, lettered_keys, prior_factors
from caliv_graph.products import Array
from tests.samples import make_calibration


def key(name: str) -> int:
    return int(gtsam.symbol("q", {"front": 3, "rear": 7, "left": 1}[name]))


def covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, *names: str) -> Array:
    marginals = gtsam.Marginals(graph, values)
    keys = gtsam.KeyVector([key(name) for name in names])
    joint = marginals.jointMarginalCovariance(keys)
    blocks = [[joint.at(key(a), key(b)) for b in names] for a in names]
    return np.asarray(np.block(blocks))


def test_the_joint_prior_has_the_joint_covariance() -> None:
    calibration = make_calibration("front", "rear", "left")
    graph = prior_factors(calibration, key)

    found = covariance(graph, extrinsic_values(calibration, key), "front", "rear", "left")

    assert graph.size() == 1
    assert found == pytest.approx(calibration.cov_joint, rel=1e-6, abs=1e-15)


def test_single_priors_have_each_lidars_covariance_and_no_more() -> None:
    calibration = make_calibration()
    graph = prior_factors(calibration, key, joint=False)

    found = covariance(graph, extrinsic_values(calibration, key), "front", "rear")

    expected = calibration.cov_joint.copy()
    expected[:6, 6:] = expected[6:, :6] = 0.0
    assert graph.size() == 2
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("joint", [True, False])
def test_the_mean_is_the_calibration(joint: bool) -> None:
    calibration = make_calibration()
    graph = prior_factors(calibration, key, joint)
    rng = np.random.default_rng(4)
    values = gtsam.Values()
    for name, lidar in calibration.lidars.items():
        values.insert(key(name), lidar.T_vehicle_lidar.retract(0.02 * rng.normal(size=6)))

    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()

    for name, lidar in calibration.lidars.items():
        assert solved.atPose3(key(name)).equals(lidar.T_vehicle_lidar, 1e-6)


def test_some_lidars_keep_their_marginal() -> None:
    calibration = make_calibration("front", "rear", "left")
    graph = prior_factors(calibration, key, lidars=["left"])

    found = covariance(graph, extrinsic_values(calibration, key), "left")

    assert list(graph.keyVector()) == [key("left")]
    assert found == pytest.approx(calibration.cov_joint[12:, 12:], rel=1e-6)


def test_what_cannot_be_a_prior() -> None:
    calibration = make_calibration()

    with pytest.raises(ExportError, match=r"lidar 'roof': is not in .*\. Name some of"):
        prior_factors(calibration, key, lidars=["roof"])
    with pytest.raises(ExportError, match="keys of front, rear are not different"):
        prior_factors(calibration, lambda _: 5)
    with pytest.raises(ExportError, match="expected one letter"):
        lettered_keys(calibration, "mm")


def test_a_covariance_that_is_nearly_singular_claims_no_more() -> None:
    calibration = make_calibration()
    cov = calibration.cov_joint.copy()
    cov[6:, :] = cov[:6, :]
    cov[:, 6:] = cov[:, :6]
    calibration = replace(calibration, cov_joint=cov)

    graph = prior_factors(calibration, key)

    ordering = gtsam.Ordering()
    for name in calibration.lidars:
        ordering.push_back(key(name))
    information = graph.linearize(extrinsic_values(calibration, key)).hessian(ordering)[0]
    sigma = np.sqrt(np.diag(cov))
    assert np.isfinite(information).all()
    assert np.linalg.eigvalsh(information * np.outer(sigma, sigma))[-1] < 1.01e10


_READER = """
import sys, gtsam
from pathlib import Path
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
graph.deserialize(Path(sys.argv[1]).read_text())
values.deserialize(Path(sys.argv[2]).read_text())
for key in sorted(values.keys()):
    print(key, *values.atPose3(key).matrix().ravel().tolist())
ordering = gtsam.Ordering()
for key in sorted(values.keys()):
    ordering.push_back(key)
print(*graph.linearize(values).hessian(ordering)[0].ravel().tolist())
print(graph.error(values))
"""


def test_a_fresh_process_reads_the_archive(tmp_path: Path) -> None:
    calibration = make_calibration()
    files = write_calibration_archive(calibration, tmp_path / "prior.gtsam", letter="k")

    said = subprocess.run(
        [sys.executable, "-c", _READER, *map(str, files[:2])],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()

    for index, (line, lidar) in enumerate(zip(said, calibration.lidars.values(), strict=False)):
        number, *entries = line.split()
        assert int(number) == gtsam.symbol("k", index)
        matrix = np.array(entries, dtype=float).reshape(4, 4)
        assert matrix == pytest.approx(lidar.T_vehicle_lidar.matrix(), abs=1e-12)
    information = np.array(said[2].split(), dtype=float).reshape(12, 12)
    assert np.linalg.inv(information) == pytest.approx(calibration.cov_joint, rel=1e-6, abs=1e-15)
    assert float(said[3]) == pytest.approx(0.0, abs=1e-9)


def test_the_yaml_beside_it_says_the_same(tmp_path: Path) -> None:
    calibration = make_calibration()
    files = write_calibration_archive(calibration, tmp_path / "prior.gtsam", letter="k")

    document = yaml.safe_load(files[2].read_text())

    assert [file.name for file in files] == ["prior.gtsam", "prior.values.gtsam", "prior.yaml"]
    assert [v["lidar"] for v in document["variables"]] == list(calibration.lidars)
    assert [(v["letter"], v["index"]) for v in document["variables"]] == [("k", 0), ("k", 1)]
    assert document["variables"][0]["T_vehicle_lidar"]["translation"] == [2.0, 0.0, 2.0]
    assert not document["variables"][0]["determined"]["yaw"]
    cov = np.linalg.inv(np.array(document["information"]))
    assert cov == pytest.approx(calibration.cov_joint, rel=1e-6, abs=1e-15)


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    calibration = make_calibration()
    path = tmp_path / "prior.gtsam"
    values = archive_paths(path)[1]
    values.write_text("mine")

    with pytest.raises(OutputError, match=r"prior\.values\.gtsam: exists already"):
        write_calibration_archive(calibration, path)

    assert [p.name for p in tmp_path.iterdir()] == ["prior.values.gtsam"]
    write_calibration_archive(calibration, path, force=True)
    assert values.read_text() != "mine"


def test_custom_factors_are_refused_and_can_be_linearised(tmp_path: Path) -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    measured = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(1, measured, noise))
    graph.add(lidar_pose_factor(1, 2, measured, noise))
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3())
    values.insert(2, gtsam.Pose3(gtsam.Rot3.Ry(0.4), np.array([0.0, 0.5, 0.0])))

    with pytest.raises(ExportError, match="factor 1 is a CustomFactor"):
        serialise(graph)
    native = serialisable(graph, values)
    write_archive(native, values, tmp_path / "graph.gtsam")

    back = gtsam.NonlinearFactorGraph()
    back.deserialize((tmp_path / "graph.gtsam").read_text())
    assert back.error(values) == pytest.approx(graph.error(values), rel=1e-12)
    before, after = (g.linearize(values).hessian() for g in (graph, back))
    assert after[0] == pytest.approx(before[0], rel=1e-12)
    assert after[1] == pytest.approx(before[1], rel=1e-12)
