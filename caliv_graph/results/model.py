"""calibration.yaml and truth.yaml as they are read: the keys, and what they become.

The models list the keys that are read, in the order in which problems are reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import gtsam
import numpy as np
from pydantic import Field, StrictBool, ValidationInfo, field_validator
from scipy.linalg import block_diag

from caliv_graph.config.model import name_problem
from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array, Calibration, DataTerm, Direction, Guess, LidarResult
from caliv_graph.results.values import (
    Count,
    Finite,
    Matrix,
    Number,
    Part,
    PoseMatrix,
    PosePart,
    Sigma,
    Text,
    Vector6,
    check_matrix,
    symmetric,
)
from caliv_graph.uncertainty.observability import rigid_twist
from caliv_graph.uncertainty.pairs import pair_covariance, sensor_pairs

SCHEMA = "caliv-graph/calibration/1"

Status = Literal["ok", "partial", "inconsistent"]


class _SigmaPart(Part):
    rpy_deg: tuple[Sigma, Sigma, Sigma]
    xyz: tuple[Sigma, Sigma, Sigma]


class _GuessPart(PosePart):
    """The initial guess of a LiDAR: its pose, and its sigmas in vehicle axes."""

    sigma_vehicle_axes: _SigmaPart
    fixed: StrictBool = False

    def guess(self) -> Guess:
        sigma = self.sigma_vehicle_axes
        sigmas = np.concatenate([np.radians(np.array(sigma.rpy_deg)), np.array(sigma.xyz)])
        return Guess(T_vehicle_lidar=self.pose(), sigmas=sigmas, fixed=self.fixed)


class _DeterminedPart(Part):
    roll: StrictBool
    pitch: StrictBool
    yaw: StrictBool
    x: StrictBool
    y: StrictBool
    z: StrictBool


class _OffsetPart(Part):
    value: Finite
    sigma: Finite


class _LidarPart(Part):
    T_vehicle_lidar: PosePart
    covariance: PoseMatrix
    determined: _DeterminedPart
    time_offset: _OffsetPart | None = None
    guess: _GuessPart | None = None
    scans_used: Count = 0
    saw_target: StrictBool | None = None

    def result(self, has_data: bool) -> LidarResult:
        """The LiDAR's part of the calibration.

        Args:
            has_data: whether the information of the data is not zero: then the LiDAR saw the
                target. Used where the file does not say `saw_target`.
        """
        offset = self.time_offset
        return LidarResult(
            T_vehicle_lidar=self.T_vehicle_lidar.pose(),
            cov=symmetric(self.covariance),
            determined={axis: getattr(self.determined, axis) for axis in AXES},
            scans_used=self.scans_used,
            saw_target=has_data if self.saw_target is None else self.saw_target,
            time_offset=None if offset is None else (offset.value, offset.sigma),
            guess=None if self.guess is None else self.guess.guess(),
        )


class _OrderedPart(Part):
    """Vectors and matrices over several LiDARs: six numbers per LiDAR, in this order."""

    order: list[Text] = Field(min_length=1)

    @field_validator("order")
    @classmethod
    def _each_once(cls, order: list[str]) -> list[str]:
        if len(set(order)) < len(order):
            raise ValueError("names a LiDAR twice")
        return order

    @field_validator("covariance", "data_information", check_fields=False)
    @classmethod
    def _matrix_of_all(cls, rows: list[list[float]], info: ValidationInfo) -> list[list[float]]:
        # A field with a problem is missing here, and is reported itself.
        return check_matrix(rows, 6 * len(info.data["order"])) if "order" in info.data else rows

    @field_validator("data_gradient", check_fields=False)
    @classmethod
    def _vector_of_all(
        cls, numbers: list[float] | None, info: ValidationInfo
    ) -> list[float] | None:
        size = 6 * len(info.data.get("order", ()))
        if numbers is not None and size and len(numbers) != size:
            raise ValueError(f"must be {size} numbers, has {len(numbers)}")
        return numbers


class _EarlierPart(_OrderedPart):
    """What an earlier drive measured."""

    drive_sha256: list[Text]
    T_vehicle_lidar: dict[Text, PosePart]
    data_information: Matrix
    data_gradient: list[Finite]

    @field_validator("T_vehicle_lidar")
    @classmethod
    def _pose_of_each(cls, poses: dict[str, PosePart], info: ValidationInfo) -> dict[str, PosePart]:
        missing = [name for name in info.data.get("order", ()) if name not in poses]
        if missing:
            raise ValueError(f"'{missing[0]}' is missing")
        return poses

    def term(self) -> DataTerm:
        """The same in vehicle axes."""
        poses = {name: self.T_vehicle_lidar[name].pose() for name in self.order}
        axes = block_diag(*(right_to_vehicle_axes(T) for T in poses.values()))
        return DataTerm(
            sources=tuple(self.drive_sha256),
            T_vehicle_lidar=poses,
            information=axes @ symmetric(self.data_information) @ axes.T,
            gradient=axes @ np.array(self.data_gradient),
        )


class _JointPart(_OrderedPart):
    covariance: Matrix
    data_information: Matrix
    data_gradient: list[Finite] | None = None
    earlier: tuple[_EarlierPart, ...] = ()


class _DirectionPart(Part):
    direction: dict[Text, Vector6]
    text: Text
    remedy: Text = ""
    together: StrictBool | None = None
    # Other writers leave these out: unknown.
    sigma_data: Number = math.nan
    sigma_prior: Number = math.nan

    def read(self, T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> Direction:
        """The direction; whether all LiDARs move as one is worked out where the file is silent."""
        vector = {name: np.array(numbers) for name, numbers in self.direction.items()}
        together = self.together
        if together is None:
            together = rigid_twist(vector, T_vehicle_lidar) is not None
        return Direction(
            vector=vector,
            sigma_data=self.sigma_data,
            sigma_prior=self.sigma_prior,
            together=together,
            text=self.text,
            remedy=self.remedy,
        )


class _ObservabilityPart(Part):
    undetermined: list[_DirectionPart]
    weak: list[_DirectionPart]


class _PairPart(Part):
    from_: Text = Field(alias="from")
    to: Text
    # Not used, for it follows from the extrinsics; but a damaged file is to be noticed.
    T_to_from: PosePart
    covariance: PoseMatrix


class CalibrationModel(Part):
    """A calibration.yaml."""

    schema_: Text = Field(alias="schema")
    lidars: dict[Text, _LidarPart] = Field(min_length=1)
    joint: _JointPart
    status: Status
    reference: Text
    observability: _ObservabilityPart
    sensor_to_sensor: list[_PairPart] | None = None
    unmet: tuple[Text, ...] = ()
    contradictions: tuple[Text, ...] = ()
    provenance: dict[Text, Any] = Field({})

    @field_validator("schema_")
    @classmethod
    def _known_schema(cls, schema: str) -> str:
        if schema != SCHEMA:
            raise ValueError(f"is not known; this version reads '{SCHEMA}'")
        return schema

    @field_validator("lidars")
    @classmethod
    def _names_can_be_shown(cls, lidars: dict[str, _LidarPart]) -> dict[str, _LidarPart]:
        for problem in filter(None, map(name_problem, lidars)):
            raise ValueError(problem)
        return lidars

    @field_validator("joint")
    @classmethod
    def _orders_all_lidars(cls, joint: _JointPart, info: ValidationInfo) -> _JointPart:
        # LiDARs with a problem are missing here, and are reported themselves.
        lidars = list(info.data.get("lidars", joint.order))
        if sorted(joint.order) != sorted(lidars):
            raise ValueError(f"order {joint.order} must have the LiDARs of the file, {lidars}")
        return joint

    @field_validator("reference")
    @classmethod
    def _reference_is_known(cls, reference: str, info: ValidationInfo) -> str:
        if reference not in info.data.get("lidars", [reference]):
            raise ValueError(f"must be a LiDAR of the file: {', '.join(info.data['lidars'])}")
        return reference

    @field_validator("observability")
    @classmethod
    def _directions_are_known(
        cls, part: _ObservabilityPart, info: ValidationInfo
    ) -> _ObservabilityPart:
        for direction in (*part.undetermined, *part.weak):
            _check_known(direction.direction, info)
        return part

    @field_validator("sensor_to_sensor")
    @classmethod
    def _pairs_are_known(
        cls, pairs: list[_PairPart] | None, info: ValidationInfo
    ) -> list[_PairPart] | None:
        for pair in pairs or ():
            _check_known([pair.from_, pair.to], info)
        return pairs

    def calibration(self) -> Calibration:
        """The calibration. The LiDARs are in the order of the matrices."""
        joint = self.joint
        information = symmetric(joint.data_information)
        lidars = {
            name: self.lidars[name].result(bool(np.any(information[6 * i : 6 * i + 6])))
            for i, name in enumerate(joint.order)
        }
        poses = {name: lidar.T_vehicle_lidar for name, lidar in lidars.items()}
        gradient = joint.data_gradient
        return Calibration(
            status=self.status,
            reference=self.reference,
            lidars=lidars,
            cov_joint=symmetric(joint.covariance),
            information_data=information,
            undetermined=tuple(d.read(poses) for d in self.observability.undetermined),
            weak=tuple(d.read(poses) for d in self.observability.weak),
            unmet=self.unmet,
            contradictions=self.contradictions,
            provenance=self.provenance,
            gradient_data=None if gradient is None else np.array(gradient),
            earlier=tuple(part.term() for part in joint.earlier),
        )

    def cov_pairs(self, calibration: Calibration) -> dict[tuple[str, str], Array]:
        """Covariances of the pairs as the file states them, else of the joint covariance."""
        if self.sensor_to_sensor is None:
            pairs = sensor_pairs(calibration.lidars, calibration.reference)
            return {pair: pair_covariance(calibration, *pair) for pair in pairs}
        return {(pair.from_, pair.to): symmetric(pair.covariance) for pair in self.sensor_to_sensor}


class _TrueLidarPart(Part):
    T_vehicle_lidar: PosePart


class TruthModel(Part):
    """A truth.yaml; a calibration.yaml is one, too."""

    lidars: dict[Text, _TrueLidarPart] = Field(min_length=1)


def _check_known(names: Iterable[str], info: ValidationInfo) -> None:
    """Raises ValueError where a name is not one of the file's LiDARs."""
    for name in names:
        if name not in info.data.get("lidars", [name]):
            known = ", ".join(info.data["lidars"])
            raise ValueError(f"'{name}' is not a LiDAR of the file: {known}")
