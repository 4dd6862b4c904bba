from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers.gtsam import export
from tests.export.requests import T_VEHICLE_LIDAR, calibration_of, request

CONSUMER = """
import json, sys
import gtsam, numpy as np
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
graph.deserialize(open(sys.argv[1]).read())
values.deserialize(open(sys.argv[2]).read())
keys = [gtsam.symbol("l", i) for i in range(2)]
# From elsewhere, the prior alone leads back to the calibrated extrinsics.
start = gtsam.Values()
for key in keys:
    start.insert(key, values.atPose3(key).retract(np.full(6, 1e-3)))
solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
cov = gtsam.Marginals(graph, values).jointMarginalCovariance(keys).fullMatrix()
print(json.dumps({
    "error": graph.error(values),
    "values": [values.atPose3(key).matrix().tolist() for key in keys],
    "solved": [solved.atPose3(key).matrix().tolist() for key in keys],
    "cov": cov.tolist(),
    "modules": [name for name in sys.modules if name.startswith("caliv")],
}))
"""


def written(folder: Path, **changes: Any) -> Path:
    """An archive on the disk."""
    path = folder / "prior.gtsam"
    made = export(request(out=path, letter="l", **changes))
    path.write_bytes(made.content)
    for beside, content in made.beside.items():
        beside.write_bytes(content)
    return path


def test_gtsam_in_a_fresh_process(tmp_path: Path) -> None:
    path = written(tmp_path)

    result = subprocess.run(
        [sys.executable, "-c", CONSUMER, str(path), str(path.with_suffix(".values.gtsam"))],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin"},
    )

    told = json.loads(result.stdout)
    assert told["modules"] == []
    assert told["error"] == pytest.approx(0.0, abs=1e-12)
    truth = [T.matrix() for T in T_VEHICLE_LIDAR.values()]
    np.testing.assert_allclose(told["values"], truth, atol=1e-9)
    np.testing.assert_allclose(told["solved"], truth, atol=1e-9)
    cov = calibration_of().cov_joint
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(
        told["cov"] / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-7
    )


def test_the_yaml_needs_no_version(tmp_path: Path) -> None:
    path = written(tmp_path)
    text = path.with_suffix(".yaml").read_text()

    document = yaml.safe_load(text)

    information = np.array(document["information"])
    cov = calibration_of().cov_joint
    np.testing.assert_allclose(information @ cov, np.eye(12), atol=1e-6)
    for variable, (name, T) in zip(document["variables"], T_VEHICLE_LIDAR.items(), strict=True):
        assert variable["lidar"] == name
        assert variable["key"] == gtsam.symbol("l", variable["index"])
        x, y, z, w = variable["T_vehicle_lidar"]["quaternion_xyzw"]
        pose = gtsam.Pose3(
            gtsam.Rot3.Quaternion(w, x, y, z), np.array(variable["T_vehicle_lidar"]["translation"])
        )
        np.testing.assert_allclose(pose.matrix(), T.matrix(), atol=1e-9)
    assert "p_parent = T p_child" in text
    assert "yaw, x (vehicle axes) not determined" in text
    assert "Variable l1." in text


def test_some_lidars_get_the_marginal_of_theirs(tmp_path: Path) -> None:
    path = written(tmp_path, lidars=("rear",))

    document = yaml.safe_load(path.with_suffix(".yaml").read_text())

    marginal = calibration_of().cov_joint[6:, 6:]
    np.testing.assert_allclose(document["information"] @ marginal, np.eye(6), atol=1e-6)


def test_letters_and_names_that_cannot_be() -> None:
    for letter in ("", "xy", "1", "é"):
        with pytest.raises(ExportError, match="expected one letter"):
            export(request(letter=letter))
    with pytest.raises(ExportError, match="would be the name of the archive and of its YAML"):
        export(request(out=Path("prior.yaml")))
