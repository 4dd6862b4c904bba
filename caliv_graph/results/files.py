"""What `calibrate` leaves behind, and reading it back: calibration.yaml, truth.yaml, target.ply.

The keys of calibration.yaml are those of SPEC 6 and, as own ones, `unmet`, `contradictions`,
`scans_used`, `saw_target`, `sigma_vehicle_axes`, `determined` of a pair, `together`, `sigma_data`,
`sigma_prior`, `provenance`, and what `compare`, `merge` and `--prior` need beside the data's
information: `guess`, `data_gradient` and `earlier`. `sensor_to_sensor`, `rpy_deg` and
`sigma_vehicle_axes` are derived from the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
import yaml
from scipy.linalg import block_diag

from caliv_graph.common.fields import Field, shorten
from caliv_graph.common.files import atomic_write
from caliv_graph.config.load import read_yaml
from caliv_graph.config.model import name_problem
from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import (
    Array,
    Calibration,
    DataTerm,
    Direction,
    Guess,
    LidarResult,
    Mixture,
)
from caliv_graph.uncertainty.observability import rigid_twist
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined, sensor_pairs

if TYPE_CHECKING:
    pass

SCHEMA = "caliv-graph/calibration/1"

STATUSES = ("ok", "partial", "inconsistent")

CALIBRATION_FILE = "calibration.yaml"

GRAPH_FILE = "graph.gtsam"

REPORT_FILE = "report.html"

RESULT_FILES = (
    CALIBRATION_FILE,
    "config.yaml",
    "target.ply",
    "target_[0-9]*.ply",
    "log.jsonl",
    REPORT_FILE,
    "graph.gtsam",
    "graph.values.gtsam",
)
"""Names in the folder of a result, for `files.output_folder`."""

_DIGITS = 12
"""Significant digits of the numbers in a file, and decimals of a pose: a picometre."""

_HEADER = """\
# Extrinsics of LiDARs on a vehicle, written by caliv-graph. Metres, radians, seconds.
# T_a_b maps points of frame b into frame a. Roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll).
# Covariances: rotation (3) then translation (3), right perturbation T Exp(d): the axes are those of
# the LiDAR (of `from` in a pair). They include the priors; data_information does not.
# determined, sigma_vehicle_axes and the directions of observability: the vehicle's axes, at the
# LiDAR's origin. `determined` of a pair: the axes of `to`.
"""


@dataclass(frozen=True)
class CalibrationFile:
    """What a calibration.yaml says.

    Attributes:
        calibration: the result.
        cov_pairs: per (from, to) the (6, 6) covariance of `T_to_from` as `sensor_to_sensor` states
            it, right perturbation (frame of `from`); derived from the joint one if that is absent.
    """

    calibration: Calibration
    cov_pairs: Mapping[tuple[str, str], Array]


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """The content of calibration.yaml (SPEC 6), plain values only.

    Raises:
        ValueError: a pose or a covariance is not finite; nobody should ever see such a file.
    """
    _check_finite(calibration)
    document = {
        "schema": SCHEMA,
        "status": calibration.status,
        "reference": calibration.reference,
        "unmet": list(calibration.unmet),
        "contradictions": list(calibration.contradictions),
        "lidars": {name: _lidar_document(result) for name, result in calibration.lidars.items()},
        "sensor_to_sensor": [
            _pair_document(calibration, source, to)
            for source, to in sensor_pairs(calibration.lidars, calibration.reference)
        ],
        "joint": {
            "order": list(calibration.lidars),
            "covariance": _symmetric(calibration.cov_joint),
            "data_information": _symmetric(calibration.information_data),
            **_gradient_document(calibration),
            **_earlier_documents(calibration),
        },
        "observability": {
            "undetermined": [_direction_document(d) for d in calibration.undetermined],
            "weak": [_direction_document(d) for d in calibration.weak],
        },
    }
    rounded: dict[str, Any] = _rounded(document)
    return {**rounded, "provenance": dict(calibration.provenance)}


def write_calibration(calibration: Calibration, path: Path, force: bool = False) -> None:
    """Writes calibration.yaml in one step. The same calibration gives the same bytes.

    Args:
        calibration: what to write.
        path: the file.
        force: replace an older one.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
        ValueError: the calibration holds numbers that are not finite.
    """
    atomic_write(path, _HEADER + _dump(calibration_document(calibration)), force)


def write_target(mixture: Mixture, path: Path, name: str) -> None:
    """Writes a reconstructed target as ASCII PLY: component means (metres) and unit normals.

    Args:
        mixture: the target, in the target frame.
        path: the file.
        name: what the target is called, for a comment in the file.

    Raises:
        OSError: it cannot be written.
    """
    header = [
        "ply",
        "format ascii 1.0",
        f"comment {' '.join(name.split())}, in the target frame, metres",
        f"element vertex {len(mixture.means_target)}",
        *(f"property float {field}" for field in ("x", "y", "z", "nx", "ny", "nz")),
        "end_header",
    ]
    rows = np.hstack([mixture.means_target, mixture.normals_target])
    body = [" ".join(f"{value:.6f}" for value in row) for row in rows]
    path.write_text("\n".join([*header, *body, ""]), encoding="utf-8")


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
    root = Field(read_yaml(path), str(path))
    schema = root.child("schema")
    if schema.value != SCHEMA:
        schema.fail(f"{shorten(schema.value)} is not known; this version reads {SCHEMA!r}")
    lidars = root.child("lidars").names()
    if not lidars:
        root.child("lidars").fail("holds no LiDAR")
    for problem in filter(None, map(name_problem, lidars)):
        root.child("lidars").fail(problem)
    order = root.child("joint").child("order")
    names = [str(item.value) for item in order.items()]
    if sorted(names) != sorted(lidars):
        order.fail(f"{names} are not the LiDARs of the file, {list(lidars)}")
    # Calibration keeps them in the order of the matrices.
    size = 6 * len(names)
    information = root.child("joint").child("data_information").symmetric(size)
    results = {
        name: _read_lidar(lidars[name], bool(np.any(information[6 * i : 6 * i + 6])))
        for i, name in enumerate(names)
    }
    poses = {name: result.T_vehicle_lidar for name, result in results.items()}
    observability = root.child("observability")
    calibration = Calibration(
        status=root.child("status").one_of(STATUSES),
        reference=root.child("reference").one_of(names),
        lidars=results,
        cov_joint=root.child("joint").child("covariance").symmetric(size),
        information_data=information,
        undetermined=_read_directions(observability.child("undetermined"), poses),
        weak=_read_directions(observability.child("weak"), poses),
        unmet=tuple(str(item.value) for item in root.get("unmet", []).items()),
        contradictions=tuple(str(item.value) for item in root.get("contradictions", []).items()),
        provenance={name: node.value for name, node in root.get("provenance", {}).names().items()},
        gradient_data=_read_gradient(root.child("joint"), size),
        earlier=tuple(map(_read_earlier, root.child("joint").get("earlier", []).items())),
    )
    return CalibrationFile(calibration, _read_cov_pairs(root, calibration))


def read_truth(path: Path) -> dict[str, gtsam.Pose3]:
    """Reads true `T_vehicle_lidar` per LiDAR from truth.yaml (SPEC 6).

    A calibration.yaml serves as well: another calibration, taken for the truth.

    Raises:
        ConfigError: it is missing, or a field is not what it should be.
    """
    lidars = Field(read_yaml(path), str(path)).child("lidars")
    truth = {name: node.child("T_vehicle_lidar").pose() for name, node in lidars.names().items()}
    if not truth:
        lidars.fail("holds no LiDAR")
    return truth


def without_infinities(document: Any) -> Any:
    """A document with None for numbers that JSON does not have."""
    if isinstance(document, Mapping):
        return {key: without_infinities(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [without_infinities(value) for value in document]
    if isinstance(document, float) and not math.isfinite(document):
        return None
    return document


def _check_finite(calibration: Calibration) -> None:
    parts = {"joint covariance": calibration.cov_joint}
    parts["data information"] = calibration.information_data
    if calibration.gradient_data is not None:
        parts["data gradient"] = calibration.gradient_data
    for term in calibration.earlier:
        parts["information of earlier data"] = term.information
        parts["gradient of earlier data"] = term.gradient
    for name, result in calibration.lidars.items():
        parts[f"pose of '{name}'"] = result.T_vehicle_lidar.matrix()
        parts[f"covariance of '{name}'"] = result.cov
    for what, values in parts.items():
        if not np.isfinite(values).all():
            raise ValueError(f"calibration: the {what} is not finite")


def _lidar_document(result: LidarResult) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(parent_axes_covariance(result.T_vehicle_lidar, result.cov)))
    offset = {}
    if result.time_offset is not None:
        value_s, sigma_s = result.time_offset
        offset["time_offset"] = {"value": float(value_s), "sigma": float(sigma_s)}
    return {
        "T_vehicle_lidar": _pose_document(result.T_vehicle_lidar),
        "covariance": _symmetric(result.cov),
        "sigma_vehicle_axes": {
            "rpy_deg": np.degrees(sigma[:3]).tolist(),
            "xyz": sigma[3:].tolist(),
        },
        "determined": {axis: bool(result.determined[axis]) for axis in AXES},
        **offset,
        **({} if result.guess is None else {"guess": _guess_document(result.guess)}),
        "saw_target": bool(result.saw_target),
        "scans_used": int(result.scans_used),
    }


def _guess_document(guess: Guess) -> dict[str, Any]:
    sigma = {"rpy_deg": np.degrees(guess.sigmas[:3]).tolist(), "xyz": guess.sigmas[3:].tolist()}
    fixed = {"fixed": True} if guess.fixed else {}
    return {**_pose_document(guess.T_vehicle_lidar), "sigma_vehicle_axes": sigma, **fixed}


def _gradient_document(calibration: Calibration) -> dict[str, Any]:
    if calibration.gradient_data is None:
        return {}
    return {"data_gradient": calibration.gradient_data.tolist()}


def _earlier_documents(calibration: Calibration) -> dict[str, Any]:
    """What earlier drives said, in right perturbations as everything under `joint`."""
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
    # Of the two that mean the same, the one whose last number that is not zero is positive.
    if xyzw[np.flatnonzero(np.abs(xyzw) > 1e-12)[-1]] < 0.0:
        xyzw = -xyzw
    parts = {
        "translation": pose.translation(),
        "quaternion_xyzw": xyzw,
        "rpy_deg": np.degrees(pose.rotation().rpy()),
    }
    # Beside numbers of the order of one, what is below the last digit is noise.
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


def _read_lidar(node: Field, has_data: bool) -> LidarResult:
    determined = node.child("determined")
    offset = node.get("time_offset", None)
    return LidarResult(
        T_vehicle_lidar=node.child("T_vehicle_lidar").pose(),
        cov=node.child("covariance").symmetric(6),
        determined={axis: determined.child(axis).flag() for axis in AXES},
        scans_used=node.get("scans_used", 0).count(),
        # What a LiDAR saw is in the data's information, also where the file is not one of ours.
        saw_target=node.get("saw_target", has_data).flag(),
        time_offset=None
        if offset.value is None
        else (offset.child("value").finite(), offset.child("sigma").finite()),
        guess=_read_guess(node),
    )


def _read_guess(lidar: Field) -> Guess | None:
    if "guess" not in lidar.names():
        return None
    node = lidar.child("guess")
    sigma = node.child("sigma_vehicle_axes")
    rpy_deg, xyz = sigma.child("rpy_deg"), sigma.child("xyz")
    sigmas = np.concatenate([np.radians(rpy_deg.vector(3)), xyz.vector(3)])
    if not (sigmas > 0.0).all():
        sigma.fail("expected numbers above zero")
    fixed = node.get("fixed", False).flag()
    return Guess(T_vehicle_lidar=node.pose(), sigmas=sigmas, fixed=fixed)


def _read_gradient(joint: Field, size: int) -> Array | None:
    return joint.child("data_gradient").vector(size) if "data_gradient" in joint.names() else None


def _read_earlier(node: Field) -> DataTerm:
    poses = node.child("T_vehicle_lidar")
    names = [str(item.value) for item in node.child("order").items()]
    T_vehicle_lidar = {name: poses.child(name).pose() for name in names}
    axes = block_diag(*(right_to_vehicle_axes(T) for T in T_vehicle_lidar.values()))
    information = node.child("data_information").symmetric(6 * len(names))
    return DataTerm(
        sources=tuple(str(item.value) for item in node.child("drive_sha256").items()),
        T_vehicle_lidar=T_vehicle_lidar,
        information=axes @ information @ axes.T,
        gradient=axes @ node.child("data_gradient").vector(6 * len(names)),
    )


def _read_directions(
    node: Field, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> tuple[Direction, ...]:
    directions = []
    for item in node.items():
        fields = item.child("direction").names()
        for name, field in fields.items():
            if name not in T_vehicle_lidar:
                field.fail(f"'{name}' is not a LiDAR of the file, {list(T_vehicle_lidar)}")
        vector = {name: field.vector(6) for name, field in fields.items()}
        together = item.get("together", None)
        directions.append(
            Direction(
                vector=vector,
                # Not in every writer's file: unknown, and said so, or found out.
                sigma_data=item.get("sigma_data", math.nan).number(),
                sigma_prior=item.get("sigma_prior", math.nan).number(),
                together=(
                    rigid_twist(vector, T_vehicle_lidar) is not None
                    if together.value is None
                    else together.flag()
                ),
                text=str(item.child("text").value),
                remedy=str(item.get("remedy", "").value),
            )
        )
    return tuple(directions)


def _read_cov_pairs(root: Field, calibration: Calibration) -> dict[tuple[str, str], Array]:
    if root.get("sensor_to_sensor", None).value is None:
        pairs = sensor_pairs(calibration.lidars, calibration.reference)
        return {pair: pair_covariance(calibration, *pair) for pair in pairs}
    cov_pairs = {}
    names = list(calibration.lidars)
    for entry in root.child("sensor_to_sensor").items():
        pair = (entry.child("from").one_of(names), entry.child("to").one_of(names))
        # Not used, for it follows from the extrinsics; but a damaged file should not go unnoticed.
        entry.child("T_to_from").pose()
        cov_pairs[pair] = entry.child("covariance").symmetric(6)
    return cov_pairs
