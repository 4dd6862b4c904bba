"""calibration.yaml: writing it, and reading it back.

`sensor_to_sensor`, `rpy_deg` and `sigma_vehicle_axes` are derived from the rest. `guess`,
`data_gradient` and `earlier` are what `compare`, `merge` and `--prior` need beside the information
of the data. `results.model` lists the keys that are read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml
from scipy.linalg import block_diag

from caliv_graph.common.files import atomic_write
from caliv_graph.config.load import read_yaml, validated
from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import TURNS, Array, Calibration, Direction, Guess, LidarResult
from caliv_graph.results.model import SCHEMA, CalibrationModel
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined, sensor_pairs

_DIGITS = 12
"""Significant digits of the numbers in a file, and decimals of a pose: a picometre."""

_REMEDY = "Give a calibration.yaml as 'caliv-graph calibrate' wrote it, unchanged"

_HEADER = """\
# Extrinsics of LiDARs on a vehicle, written by caliv-graph. Metres, radians, seconds.
# T_a_b maps points of frame b into frame a. Roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll).
# Covariances: rotation (3) then translation (3), right perturbation T Exp(d): the axes are those of
# the LiDAR (of `from` in a pair). They include the priors; data_information does not.
# determined, sigma_vehicle_axes and the directions of observability: the vehicle's axes, at the
# LiDAR's origin. `determined` of a pair: the axes of `to`.
# vehicle: what was measured by hand, as estimated. lever_arm: the GNSS antenna in the vehicle's
# axes; imu_place: the IMU. imu_rotation, wheels_rotation: roll, pitch, yaw of T_vehicle_imu or
# T_vehicle_wheels, sigmas about the vehicle's axes. *_time_offset: stamps of a sensor less the true
# times, in the clock of the LiDARs. One per drive: speed_scale, measured over true speeds;
# heading_yaw, the direction of the baseline of two antennas.
"""


@dataclass(frozen=True)
class CalibrationFile:
    """The content of a calibration.yaml.

    Attributes:
        calibration: the result.
        cov_pairs: per (from, to) the (6, 6) covariance of `T_to_from` as `sensor_to_sensor` states
            it, right perturbation (frame of `from`); derived from the joint one if that is absent.
    """

    calibration: Calibration
    cov_pairs: Mapping[tuple[str, str], Array]


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """The content of calibration.yaml, plain values only.

    Raises:
        ValueError: a pose or a covariance is not finite: such a file is never written.
    """
    _check_finite(calibration)
    gradient = calibration.gradient_data
    document = {
        "schema": SCHEMA,
        "status": calibration.status,
        "reference": calibration.reference,
        "unmet": list(calibration.unmet),
        "contradictions": list(calibration.contradictions),
        "warnings": list(calibration.warnings),
        **_suspect_documents(calibration),
        "lidars": {name: _lidar_document(result) for name, result in calibration.lidars.items()},
        "sensor_to_sensor": [
            _pair_document(calibration, source, to)
            for source, to in sensor_pairs(calibration.lidars, calibration.reference)
        ],
        "joint": {
            "order": list(calibration.lidars),
            "covariance": _symmetric(calibration.cov_joint),
            "data_information": _symmetric(calibration.information_data),
            **({} if gradient is None else {"data_gradient": gradient.tolist()}),
            **_earlier_documents(calibration),
        },
        **_vehicle_document(calibration),
        **_structure_document(calibration),
        "observability": {
            "undetermined": [_direction_document(d) for d in calibration.undetermined],
            "weak": [_direction_document(d) for d in calibration.weak],
        },
    }
    rounded: dict[str, Any] = _rounded(document)
    return {**rounded, "provenance": dict(calibration.provenance)}


def write_calibration(calibration: Calibration, path: Path, force: bool = False) -> None:
    """Writes calibration.yaml in one step. The same calibration gives the same bytes.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
        ValueError: the calibration holds numbers that are not finite.
    """
    atomic_write(path, _HEADER + _dump(calibration_document(calibration)), force)


def read_calibration(path: Path) -> Calibration:
    """Reads calibration.yaml.

    Raises:
        ConfigError: it is missing, of another schema, or a field is not what it should be.
    """
    return read_calibration_file(path).calibration


def read_calibration_file(path: Path) -> CalibrationFile:
    """Reads calibration.yaml with the covariances of its pairs. Unknown keys are ignored.

    Raises:
        ConfigError: it is missing, of another schema, or a field is not what it should be.
    """
    expected = "calibration: expected keys such as 'schema', 'lidars'"
    model = validated(CalibrationModel, read_yaml(path), str(path), expected, _REMEDY)
    calibration = model.calibration()
    return CalibrationFile(calibration, model.cov_pairs(calibration))


def _check_finite(calibration: Calibration) -> None:
    parts = {"joint covariance": calibration.cov_joint}
    parts["data information"] = calibration.information_data
    if calibration.gradient_data is not None:
        parts["data gradient"] = calibration.gradient_data
    for term in calibration.earlier:
        parts["information of earlier data"] = term.information
        parts["gradient of earlier data"] = term.gradient
    for name, found in calibration.vehicle.items():
        parts[f"value of vehicle.{name}"] = found.value
        parts[f"sigma of vehicle.{name}"] = found.sigma
    for name, result in calibration.lidars.items():
        parts[f"pose of '{name}'"] = result.T_vehicle_lidar.matrix()
        parts[f"covariance of '{name}'"] = result.cov
    for what, values in parts.items():
        if not np.isfinite(values).all():
            raise ValueError(f"calibration: the {what} is not finite")


def _suspect_documents(calibration: Calibration) -> dict[str, Any]:
    """The ranking of inputs that could be wrong, the first one first."""
    documents = [
        {
            "input": s.input,
            "value": list(s.value),
            "sigma": list(s.sigma),
            "change": list(s.change),
            "units": list(s.units),
            "explains": s.explains,
            "sigmas": s.sigmas,
            "sigmas_left": s.sigmas_left,
            **({} if all(s.determined) else {"determined": list(s.determined)}),
        }
        for s in calibration.suspects
    ]
    return {"suspects": documents} if documents else {}


def _lidar_document(result: LidarResult) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(parent_axes_covariance(result.T_vehicle_lidar, result.cov)))
    offset = {}
    if result.time_offset is not None:
        value_s, sigma_s = result.time_offset
        offset["time_offset"] = {"value": float(value_s), "sigma": float(sigma_s)}
    return {
        "T_vehicle_lidar": _pose_document(result.T_vehicle_lidar),
        "covariance": _symmetric(result.cov),
        "sigma_vehicle_axes": _sigma_document(sigma),
        "determined": {axis: bool(result.determined[axis]) for axis in AXES},
        **offset,
        **({} if result.guess is None else {"guess": _guess_document(result.guess)}),
        "saw_target": bool(result.saw_target),
        **({"saw_structure": True} if result.saw_structure else {}),
        "scans_used": int(result.scans_used),
    }


def _vehicle_document(calibration: Calibration) -> dict[str, Any]:
    """Lever arm in metres, rotation of the IMU in degrees; nothing where both are exact."""
    out = {}
    for name, found in calibration.vehicle.items():
        turn = name in TURNS
        unit, suffix = (180.0 / math.pi, "_deg") if turn else (1.0, "")
        out[name] = {
            f"value{suffix}": (unit * found.value).tolist(),
            f"sigma{suffix}": (unit * found.sigma).tolist(),
            "determined": [bool(yes) for yes in found.determined],
            "limits": list(found.limits),
        }
    return {"vehicle": out} if out else {}


def _structure_document(calibration: Calibration) -> dict[str, Any]:
    """What was used of walls and other structure; nothing where none was."""
    found = calibration.structure
    if found is None:
        return {}
    document = {
        "strips": found.strips,
        "surfaces": found.surfaces,
        "offset_m": found.offset_m,
        "sightings": dict(found.sightings),
        "shared_surfaces": [
            {"from": a, "to": b, "surfaces": count} for (a, b), count in found.shared.items()
        ],
    }
    return {"structure": document}


def _guess_document(guess: Guess) -> dict[str, Any]:
    sigma = _sigma_document(guess.sigmas)
    flags = {"fixed": True} if guess.fixed else {"found": True} if guess.found else {}
    return {**_pose_document(guess.T_vehicle_lidar), "sigma_vehicle_axes": sigma, **flags}


def _sigma_document(sigmas: Array) -> dict[str, Any]:
    return {"rpy_deg": np.degrees(sigmas[:3]).tolist(), "xyz": sigmas[3:].tolist()}


def _earlier_documents(calibration: Calibration) -> dict[str, Any]:
    """The data of earlier drives, in right perturbations as everything under `joint`."""
    documents = []
    for term in calibration.earlier:
        axes = block_diag(*(right_to_vehicle_axes(T) for T in term.T_vehicle_lidar.values()))
        documents.append(
            {
                "drive_sha256": list(term.sources),
                "T_vehicle_lidar": {
                    name: _pose_document(T) for name, T in term.T_vehicle_lidar.items()
                },
                "order": list(term.T_vehicle_lidar),
                "data_information": _symmetric(axes.T @ term.information @ axes),
                "data_gradient": (axes.T @ term.gradient).tolist(),
            }
        )
    return {"earlier": documents} if documents else {}


def _pair_document(calibration: Calibration, source: str, to: str) -> dict[str, Any]:
    T_vehicle_from, T_vehicle_to = (
        calibration.lidars[name].T_vehicle_lidar for name in (source, to)
    )
    return {
        "from": source,
        "to": to,
        "T_to_from": _pose_document(T_vehicle_to.between(T_vehicle_from)),
        "covariance": _symmetric(pair_covariance(calibration, source, to)),
        "determined": pair_determined(calibration, source, to),
    }


def _direction_document(direction: Direction) -> dict[str, Any]:
    return {
        "direction": {
            name: np.asarray(vector).tolist() for name, vector in direction.vector.items()
        },
        "text": direction.text,
        **({"remedy": direction.remedy} if direction.remedy else {}),
        "together": bool(direction.together),
        "sigma_data": float(direction.sigma_data),
        "sigma_prior": float(direction.sigma_prior),
    }


def _pose_document(pose: gtsam.Pose3) -> dict[str, Any]:
    quaternion: Any = pose.rotation().toQuaternion()
    xyzw = np.array([quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()])
    # q and -q are the same rotation: write the one whose last nonzero number is positive.
    if xyzw[np.flatnonzero(np.abs(xyzw) > 1e-12)[-1]] < 0.0:
        xyzw = -xyzw
    parts = {
        "translation": pose.translation(),
        "quaternion_xyzw": xyzw,
        "rpy_deg": np.degrees(pose.rotation().rpy()),
    }
    # The numbers are of the order of one: digits below the last are noise.
    return {key: np.round(values, _DIGITS).tolist() for key, values in parts.items()}


def _symmetric(matrix: Array) -> list[list[float]]:
    rows: list[list[float]] = ((matrix + matrix.T) / 2.0).tolist()
    return rows


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    # Adding zero takes the sign off a negative zero.
    return float(f"{value:.{_DIGITS}g}") + 0.0 if isinstance(value, float) else value


def _dump(document: Mapping[str, Any]) -> str:
    """YAML with one row of a matrix, and one sentence, per line."""
    return yaml.safe_dump(
        dict(document),
        sort_keys=False,
        default_flow_style=None,
        width=math.inf,
        allow_unicode=True,
    )
