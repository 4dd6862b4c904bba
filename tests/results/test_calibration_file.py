from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.errors import ConfigError, OutputError
from caliv_graph.products import DataTerm, Direction, Guess, Suspect, VehicleParameter
from caliv_graph.results.calibration_file import (
    read_calibration,
    read_calibration_file,
    write_calibration,
)
from caliv_graph.results.model import SCHEMA
from tests.samples import make_calibration, unseen


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    write_calibration(make_calibration(), path)
    return path


def edit(path: Path, change: Callable[[Any], object]) -> Path:
    """Changes a file by hand, as it were."""
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))
    return path


REMEDY = ". Give a calibration.yaml as 'caliv-graph calibrate' wrote it, unchanged"


def error_of(path: Path) -> str:
    """A message about a damaged file, without the name of the file and what to do."""
    with pytest.raises(ConfigError) as caught:
        read_calibration(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert message.endswith(REMEDY)
    return message.removeprefix(f"{path}: ").removesuffix(REMEDY)


def set_at(*keys: Any, value: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


def delete_at(*keys: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    weak = Direction(
        vector={"front": np.arange(6.0), "rear": np.ones(6)},
        sigma_data=0.2,
        sigma_prior=1.0,
        together=False,
        text="front's z: weakly",
    )
    calibration = unseen(
        make_calibration("front", "left", "rear", status="ok", unmet=("s2v: yaw",), weak=(weak,)),
        "left",
    )
    calibration = replace(calibration, warnings=("2 scans are missing: wait",))
    write_calibration(calibration, tmp_path / "calibration.yaml")

    back = read_calibration(tmp_path / "calibration.yaml")

    for field in ("status", "reference", "unmet", "warnings", "provenance"):
        assert getattr(back, field) == getattr(calibration, field)
    assert list(back.lidars) == ["front", "left", "rear"]
    for name, result in calibration.lidars.items():
        assert back.lidars[name].T_vehicle_lidar.equals(result.T_vehicle_lidar, 1e-11)
        assert back.lidars[name].cov == pytest.approx(result.cov, rel=1e-11)
        assert back.lidars[name].determined == result.determined
        assert back.lidars[name].scans_used == result.scans_used
        assert back.lidars[name].saw_target == result.saw_target
    assert back.cov_joint == pytest.approx(calibration.cov_joint, rel=1e-11)
    assert back.information_data == pytest.approx(calibration.information_data, rel=1e-11)
    for ours, theirs in zip(
        (*back.undetermined, *back.weak),
        (*calibration.undetermined, *calibration.weak),
        strict=True,
    ):
        for field in ("text", "together", "sigma_data", "sigma_prior"):
            assert getattr(ours, field) == getattr(theirs, field)
        for name, vector in theirs.vector.items():
            assert ours.vector[name] == pytest.approx(vector)


def test_the_same_calibration_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    write_calibration(make_calibration(), tmp_path / "again.yaml")

    assert (tmp_path / "again.yaml").read_bytes() == written.read_bytes()


def test_keys_and_values_of_the_specification(written: Path) -> None:
    document = yaml.safe_load(written.read_text())

    assert document["schema"] == SCHEMA == "caliv-graph/calibration/1"
    assert document["status"] == "partial"
    assert document["reference"] == "rear"
    front = document["lidars"]["front"]
    pose = front["T_vehicle_lidar"]
    assert pose["translation"] == [2.0, 0.0, 2.0]
    # Nose down by 10 degrees: a rotation about y, and x y z w.
    half = math.radians(5.0)
    assert pose["quaternion_xyzw"] == pytest.approx([0, math.sin(half), 0, math.cos(half)])
    assert pose["rpy_deg"] == pytest.approx([0.0, 10.0, 0.0])
    assert np.shape(front["covariance"]) == (6, 6)
    assert front["determined"] == {
        "roll": True,
        "pitch": True,
        "yaw": False,
        "x": False,
        "y": True,
        "z": True,
    }
    (pair,) = document["sensor_to_sensor"]
    assert (pair["from"], pair["to"]) == ("front", "rear")
    # From the rear LiDAR, which looks back with its nose down by 10 degrees, the front one is
    # 2.4 m behind it: by cos(10) along -x, and by sin(10) down.
    a = math.radians(10.0)
    assert pair["T_to_from"]["translation"] == pytest.approx(
        [-2.4 * math.cos(a), 0.0, -2.4 * math.sin(a)], abs=1e-11
    )
    assert np.shape(pair["covariance"]) == (6, 6)
    assert document["joint"]["order"] == ["front", "rear"]
    assert np.shape(document["joint"]["covariance"]) == (12, 12)
    assert np.shape(document["joint"]["data_information"]) == (12, 12)
    (undetermined,) = document["observability"]["undetermined"]
    # 1 rad about a centre 9.16 m to the right: the front, 2 m ahead, moves back by 9.16 m ...
    assert undetermined["direction"]["front"] == pytest.approx([0, 0, 1, -9.16, 2.0, 0])
    assert undetermined["text"] == "rotation of all LiDARs about the turn centre"
    assert undetermined["sigma_data"] == math.inf
    assert document["observability"]["weak"] == []


def test_a_person_can_read_it(written: Path) -> None:
    lines = written.read_text().splitlines()

    assert lines[0].startswith("# ")
    # One row of a matrix per line: 2 x 6 of the LiDARs, 6 of the pair, 12 of each joint matrix.
    assert sum(line.lstrip().startswith("- [") for line in lines) == 2 * 6 + 6 + 2 * 12
    assert (
        "    determined: {roll: true, pitch: true, yaw: false, x: false, y: true, z: true}" in lines
    )
    assert "-0.0" not in written.read_text().replace(", ", " ").split()


def test_one_lidar_has_no_pairs(tmp_path: Path) -> None:
    write_calibration(make_calibration("rear"), tmp_path / "calibration.yaml")

    file = read_calibration_file(tmp_path / "calibration.yaml")

    assert file.cov_pairs == {}
    assert file.calibration.cov_joint.shape == (6, 6)


def test_a_calibration_that_is_not_finite_is_never_written(tmp_path: Path) -> None:
    cov = make_calibration().cov_joint.copy()
    cov[3, 3] = math.nan

    with pytest.raises(ValueError, match="joint covariance is not finite"):
        write_calibration(make_calibration(cov_joint=cov), tmp_path / "calibration.yaml")

    assert list(tmp_path.iterdir()) == []


def test_writing_replaces_only_with_force(written: Path) -> None:
    before = written.read_bytes()

    with pytest.raises(OutputError, match="--force"):
        write_calibration(make_calibration(status="ok"), written)
    assert written.read_bytes() == before

    write_calibration(make_calibration(status="ok"), written, force=True)
    assert read_calibration(written).status == "ok"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            set_at("schema", value="caliv-graph/calibration/2"),
            "'schema': must be 'caliv-graph/calibration/1' (got 'caliv-graph/calibration/2')",
        ),
        (delete_at("schema"), "'schema' is missing"),
        (
            set_at("status", value="fine"),
            "'status': must be 'ok', 'partial' or 'inconsistent' (got 'fine')",
        ),
        (
            set_at("reference", value="roof"),
            "'reference': 'roof' is not a LiDAR of the file: front, rear",
        ),
        (set_at("lidars", value={}), "'lidars': must have 1 or more items, has 0"),
        (set_at("lidars", value=[1]), "'lidars': must be keys with values (got '[1]')"),
        (
            delete_at("lidars", "front", "T_vehicle_lidar", "translation"),
            "'lidars.front.T_vehicle_lidar.translation' is missing",
        ),
        (
            set_at("lidars", "front", "T_vehicle_lidar", "translation", 1, value=math.nan),
            "'lidars.front.T_vehicle_lidar.translation.1': must be a finite number (got 'nan')",
        ),
        (
            set_at("lidars", "front", "T_vehicle_lidar", "translation", value=[1, 2]),
            "'lidars.front.T_vehicle_lidar.translation.2' is missing",
        ),
        (
            set_at("lidars", "front", "T_vehicle_lidar", "translation", 0, value=True),
            "'lidars.front.T_vehicle_lidar.translation.0': must be a number (got 'True')",
        ),
        (
            set_at("lidars", "front", "T_vehicle_lidar", "quaternion_xyzw", value=[0, 0, 0, 1.1]),
            "'lidars.front.T_vehicle_lidar.quaternion_xyzw': must have norm 1 within 0.001, has "
            "1.1 (got '[0, 0, 0, 1.1]')",
        ),
        (
            set_at("lidars", "rear", "covariance", 2, 2, value=math.nan),
            "'lidars.rear.covariance.2.2': must be a finite number (got 'nan')",
        ),
        (
            set_at("lidars", "rear", "covariance", 2, value=[0, 0, 1, 0, 0]),
            "'lidars.rear.covariance': must have 6 numbers in row 3, has 5",
        ),
        (
            set_at("lidars", "rear", "covariance", value=[[1.0]]),
            "'lidars.rear.covariance': must be 6 rows of 6 numbers, has 1 rows (got '[[1.0]]')",
        ),
        (
            set_at("lidars", "rear", "covariance", 2, 2, value=-1e-6),
            "'lidars.rear.covariance': is no covariance: -1e-06 on the diagonal, in row 3",
        ),
        (
            set_at("lidars", "rear", "determined", "yaw", value="no"),
            "'lidars.rear.determined.yaw': must be true or false (got 'no')",
        ),
        (
            set_at("joint", "order", value=["front", "left"]),
            "'joint.order': ['front', 'left'] must be the LiDARs of the file, ['front', 'rear']",
        ),
        (
            delete_at("joint", "data_information", 0),
            "'joint.data_information': must be 12 rows of 12 numbers, has 11 rows",
        ),
        (
            set_at("joint", "order", value=["front", "front"]),
            "'joint.order': names a LiDAR twice (got \"['front', 'front']\")",
        ),
        (
            set_at("joint", "data_gradient", value=[]),
            "'joint.data_gradient': must be 12 numbers, has 0 (got '[]')",
        ),
        (delete_at("observability"), "'observability' is missing"),
        (
            set_at("observability", "undetermined", 0, "direction", value={"roof": [0] * 6}),
            "'observability': 'roof' is not a LiDAR of the file: front, rear",
        ),
        (
            set_at("sensor_to_sensor", 0, "to", value="roof"),
            "'sensor_to_sensor': 'roof' is not a LiDAR of the file: front, rear",
        ),
        (
            set_at("sensor_to_sensor", 0, "T_to_from", "quaternion_xyzw", value=[0, 0, 0, 0]),
            "'sensor_to_sensor.0.T_to_from.quaternion_xyzw': must have norm 1 within 0.001, has 0 "
            "(got '[0, 0, 0, 0]')",
        ),
    ],
)
def test_damage_is_named_with_file_and_field(
    written: Path, change: Callable[[Any], None], message: str
) -> None:
    assert error_of(edit(written, change)) == message


def test_a_covariance_that_is_not_symmetric(written: Path) -> None:
    message = error_of(edit(written, set_at("joint", "covariance", 1, 7, value=1e-3)))

    assert message.startswith(
        "'joint.covariance': is not symmetric: 0.001 in row 2, column 8, but "
    )


def test_a_covariance_that_is_indefinite(written: Path) -> None:
    # Perfect correlation and more: 2 between variances of 1.
    cov = np.eye(6)
    cov[0, 1] = cov[1, 0] = 2.0

    message = error_of(edit(written, set_at("lidars", "front", "covariance", value=cov.tolist())))

    assert message == (
        "'lidars.front.covariance': is not positive semidefinite: scaled to ones on its diagonal "
        "it has the eigenvalue -1"
    )


def test_semidefinite_is_enough(written: Path) -> None:
    # Without prior, what was not determined has no information; a trusted LiDAR no variance.
    zeros = np.zeros((12, 12)).tolist()
    edit(written, set_at("joint", "data_information", value=zeros))
    edit(written, set_at("lidars", "front", "covariance", value=np.zeros((6, 6)).tolist()))

    calibration = read_calibration(written)

    assert not calibration.information_data.any()


def test_the_smallest_file_of_the_specification_is_read(written: Path) -> None:
    """Own keys are absent, unknown ones present, and numbers as yaml-cpp writes them."""

    def change(document: Any) -> None:
        for key in ("unmet", "provenance", "sensor_to_sensor"):
            del document[key]
        for lidar in document["lidars"].values():
            for key in ("scans_used", "saw_target", "sigma_vehicle_axes"):
                del lidar[key]
            lidar["time_offset"] = {"value": 0.01, "sigma": 0.001}
        for key in ("sigma_data", "together"):
            del document["observability"]["undetermined"][0][key]
        document["lidars"]["front"]["T_vehicle_lidar"]["translation"][1] = "1e-05"
        document["comment"] = "nothing we know"

    file = read_calibration_file(edit(written, change))

    front = file.calibration.lidars["front"]
    assert front.T_vehicle_lidar.translation()[1] == 1e-05
    assert front.saw_target
    assert math.isnan(file.calibration.undetermined[0].sigma_data)
    assert file.calibration.undetermined[0].together
    assert list(file.cov_pairs) == [("front", "rear")]


def test_the_stated_covariance_of_a_pair_is_kept(written: Path) -> None:
    cov = (4.0 * np.eye(6)).tolist()

    file = read_calibration_file(
        edit(written, set_at("sensor_to_sensor", 0, "covariance", value=cov))
    )

    assert file.cov_pairs["front", "rear"] == pytest.approx(4.0 * np.eye(6))


def test_a_quaternion_and_its_negative_are_one_rotation(tmp_path: Path) -> None:
    for number, angle in enumerate((179.999, -179.999)):
        rotation = gtsam.Rot3.RzRyRx(0.0, 0.0, math.radians(angle))
        calibration = make_calibration("rear", undetermined=())
        result = calibration.lidars["rear"]
        moved = type(result)(
            gtsam.Pose3(rotation, np.zeros(3)), result.cov, result.determined, 1, True
        )
        write_calibration(
            make_calibration("rear", lidars={"rear": moved}, undetermined=()),
            tmp_path / f"{number}.yaml",
        )
        document = yaml.safe_load((tmp_path / f"{number}.yaml").read_text())
        assert document["lidars"]["rear"]["T_vehicle_lidar"]["quaternion_xyzw"][3] > 0.0


def test_what_merging_needs_survives_the_file(tmp_path: Path) -> None:
    """Guesses, gradient and earlier data, turned to the LiDARs' axes and back."""
    calibration = make_calibration()
    rng = np.random.default_rng(2)
    poses = {
        n: lidar.T_vehicle_lidar for n, lidar in make_calibration("left", "rear").lidars.items()
    }
    term = DataTerm(("a", "b"), poses, np.diag(rng.uniform(1.0, 2.0, 12)), rng.normal(size=12))
    guess = Guess(poses["rear"], np.array([0.03, 0.03, 0.04, 0.1, 0.2, 0.3]), fixed=True)
    lidars = dict(calibration.lidars)
    lidars["rear"] = replace(lidars["rear"], guess=guess)
    calibration = replace(
        calibration, lidars=lidars, gradient_data=rng.normal(size=12), earlier=(term,)
    )

    write_calibration(calibration, tmp_path / "calibration.yaml")
    back = read_calibration(tmp_path / "calibration.yaml")

    assert back.gradient_data == pytest.approx(calibration.gradient_data, rel=1e-11)
    assert back.lidars["front"].guess is None
    stated = back.lidars["rear"].guess
    assert stated is not None
    assert stated.fixed
    assert stated.sigmas == pytest.approx(guess.sigmas, rel=1e-11)
    assert stated.T_vehicle_lidar.equals(guess.T_vehicle_lidar, 1e-11)
    (read,) = back.earlier
    assert read.sources == ("a", "b")
    assert list(read.T_vehicle_lidar) == ["left", "rear"]
    assert read.information == pytest.approx(term.information, rel=1e-9, abs=1e-9)
    assert read.gradient == pytest.approx(term.gradient, rel=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("xyz: [0.1, 0.2, 0.3]", "xyz: [0.1, 0.0, 0.3]", "xyz.1': must be greater than 0"),
        ("fixed: true", "fixed: maybe", "must be true or false \\(got 'maybe'\\)"),
    ],
)
def test_a_guess_that_is_none(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    calibration = make_calibration("front")
    lidar = calibration.lidars["front"]
    guess = Guess(lidar.T_vehicle_lidar, np.array([0.03] * 3 + [0.1, 0.2, 0.3]), fixed=True)
    path = tmp_path / "calibration.yaml"
    write_calibration(replace(calibration, lidars={"front": replace(lidar, guess=guess)}), path)
    path.write_text(path.read_text().replace(old, new))

    with pytest.raises(ConfigError, match=complaint):
        read_calibration(path)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1, 2.5, 1e300, "many", None])
def test_scans_are_counted_in_whole_numbers(written: Path, value: Any) -> None:
    edit(written, set_at("lidars", "front", "scans_used", value=value))

    assert error_of(written).startswith("'lidars.front.scans_used': ")


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_a_time_offset_is_finite(written: Path, value: float) -> None:
    for part in ({"value": value, "sigma": 0.1}, {"value": 0.1, "sigma": value}):
        edit(written, set_at("lidars", "front", "time_offset", value=part))

        assert "must be a finite number" in error_of(written)


def test_a_name_that_no_table_could_show(written: Path) -> None:
    written.write_text(written.read_text().replace("front", '"a\\e[31m"'))

    assert "cannot be the name of a LiDAR" in error_of(written)


def test_numbers_whose_square_no_float_holds(written: Path) -> None:
    """Two of them beside each other made the check of symmetry compare NaN."""
    for at, value in (((0, 0), 1e308), ((0, 1), 1.7e308)):
        for row, column in {at, at[::-1]}:
            keys = ("lidars", "front", "covariance", row, column)
            edit(written, set_at(*keys, value=value))

        assert "'lidars.front.covariance': must be within +-1e+60, has 1" in error_of(written)


def test_a_lidar_beyond_the_earth(written: Path) -> None:
    edit(written, set_at("lidars", "rear", "T_vehicle_lidar", "translation", 1, value=-1e200))

    assert "translation': must be within 1e+08 m" in error_of(written)


def test_a_long_schema_is_not_repeated_whole(written: Path) -> None:
    edit(written, set_at("schema", value="9" * 100_000))

    assert len(error_of(written)) < 500


def test_earlier_data_of_other_lidars(tmp_path: Path) -> None:
    """What an earlier drive measured has LiDARs of its own, and a pose of each."""
    lidars = make_calibration("left", "rear").lidars
    poses = {name: lidar.T_vehicle_lidar for name, lidar in lidars.items()}
    term = DataTerm(("a",), poses, np.eye(12), np.zeros(12))
    path = tmp_path / "calibration.yaml"
    write_calibration(replace(make_calibration(), earlier=(term,)), path)
    earlier = ("joint", "earlier", 0)

    edit(path, delete_at(*earlier, "T_vehicle_lidar", "left"))
    assert (
        error_of(path)
        == "'joint.earlier.0.T_vehicle_lidar': must have a pose of each of left, rear"
    )
    edit(path, set_at(*earlier, "order", value=["rear"]))
    assert error_of(path).startswith("'joint.earlier.0.data_information': must be 6 rows")
    edit(path, set_at(*earlier, "order", value=[]))
    assert error_of(path).startswith("'joint.earlier.0.order': must have 1 or more items")


def test_names_that_yaml_takes_for_something_else(written: Path) -> None:
    """Another writer leaves out the quotes that the name 1, 2026-11-20 or no needs."""
    text = written.read_text()
    for name in ("1", "2026-11-20", "no", "~"):
        written.write_text(text.replace("front", name))

        assert list(read_calibration(written).lidars)[1] == "rear"


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_calibration(tmp_path / "nowhere.yaml")


def test_what_was_measured_by_hand_is_written_and_read_back(tmp_path: Path) -> None:
    arm = VehicleParameter(
        np.array([1.2, 0.3, 0.85]), np.array([0.01, 0.02, 2.0]), (True, True, False), ("x", "y")
    )
    turn = VehicleParameter(np.radians([90.0, 0.0, 2.0]), np.radians([0.1, 0.1, 0.2]), (False,) * 3)
    scales = VehicleParameter(np.array([1.02, 1.019]), np.array([1e-3, 2e-3]), (True, False))
    yaw = VehicleParameter(np.radians([91.0]), np.radians([0.2]), (True,))
    measured = {"lever_arm": arm, "imu_rotation": turn, "wheels_rotation": turn}
    measured |= {"speed_scale": scales, "heading_yaw": yaw}
    clock = VehicleParameter(np.array([0.0251]), np.array([3e-4]), (True,), ("x",))
    measured |= {"gnss_time_offset": clock, "imu_time_offset": clock, "twist_time_offset": clock}
    calibration = replace(make_calibration(), vehicle=measured)

    write_calibration(calibration, tmp_path / "calibration.yaml")

    document = yaml.safe_load((tmp_path / "calibration.yaml").read_text())["vehicle"]
    assert document["lever_arm"]["value"] == [1.2, 0.3, 0.85]
    assert document["lever_arm"]["determined"] == [True, True, False]
    assert document["imu_rotation"]["value_deg"] == pytest.approx([90.0, 0.0, 2.0])
    assert document["imu_rotation"]["sigma_deg"] == pytest.approx([0.1, 0.1, 0.2])
    assert document["speed_scale"]["value"] == [1.02, 1.019]
    assert document["heading_yaw"]["value_deg"] == pytest.approx([91.0])
    assert document["imu_time_offset"]["value"] == [0.0251]
    found = read_calibration(tmp_path / "calibration.yaml").vehicle
    assert list(found) == list(measured)
    for name, expected in calibration.vehicle.items():
        np.testing.assert_allclose(found[name].value, expected.value, atol=1e-12)
        np.testing.assert_allclose(found[name].sigma, expected.sigma, atol=1e-12)
        assert found[name].determined == expected.determined
        assert found[name].limits == expected.limits


def test_scales_of_some_drives_and_sigmas_of_others_are_refused(tmp_path: Path) -> None:
    scales = VehicleParameter(np.array([1.02, 1.019]), np.array([1e-3]), (True, False))
    path = tmp_path / "calibration.yaml"
    write_calibration(replace(make_calibration(), vehicle={"speed_scale": scales}), path)
    with pytest.raises(ConfigError, match="one entry per drive"):
        read_calibration(path)


def test_suspects_are_read_back_and_may_be_those_of_another_writer(tmp_path: Path) -> None:
    first = Suspect(
        "gnss.lever_arm",
        (1.2, 0.3, 0.85),
        (0.02,) * 3,
        (0.2, 0.0, 0.0),
        ("m",) * 3,
        0.96,
        41.0,
        41.0,
    )
    path = tmp_path / "calibration.yaml"
    write_calibration(make_calibration(suspects=(first,)), path)
    assert read_calibration(path).suspects == (first,)
    document = yaml.safe_load(path.read_text())
    assert document["suspects"][0]["input"] == "gnss.lever_arm"
    keys = {"input", "value", "sigma", "explains", "sigmas"}
    few = [{key: document["suspects"][0][key] for key in keys}]
    found = read_calibration(edit(path, set_at("suspects", value=few))).suspects[0]
    assert (found.input, found.value, found.change) == (first.input, first.value, ())
