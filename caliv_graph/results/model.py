"""calibration.yaml and truth.yaml as they are read: the keys, and what they become.

The models list the keys that are read, in the order in which problems are reported. A number may be
text: some writers drop the point of 1.0e-05, and YAML 1.1 takes 1e-05 for text.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, get_args

import gtsam
import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    StrictBool,
    ValidationInfo,
    field_validator,
    model_validator,
)
from scipy.linalg import block_diag

from caliv_graph.config.lidars import checked_names
from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import (
    Array,
    Calibration,
    DataTerm,
    Direction,
    Guess,
    LidarResult,
    Suspect,
)
from caliv_graph.results.fields import (
    Count,
    Finite,
    Matrix,
    Number,
    Part,
    PoseMatrix,
    Sigma,
    Text,
    Vector6,
    check_matrix,
    near,
    symmetric,
    unit,
)
from caliv_graph.results.structure import StructurePart
from caliv_graph.results.vehicle import VehiclePart
from caliv_graph.uncertainty.observability import rigid_twist
from caliv_graph.uncertainty.pairs import pair_covariance, sensor_pairs

Schema = Literal["caliv-graph/calibration/1"]
(SCHEMA,) = get_args(Schema)

Status = Literal["ok", "partial", "inconsistent"]


class PosePart(Part):
    """A pose `T_a_b`, metres. `rpy_deg` beside these is for people, and is not read."""

    translation: Annotated[tuple[Finite, Finite, Finite], AfterValidator(near)]
    quaternion_xyzw: Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(unit)]

    def pose(self) -> gtsam.Pose3:
        """`T_a_b`."""
        xyzw = np.array(self.quaternion_xyzw)
        x, y, z, w = xyzw / float(np.linalg.norm(xyzw))
        return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(self.translation))


class _SigmaPart(Part):
    rpy_deg: tuple[Sigma, Sigma, Sigma]
    xyz: tuple[Sigma, Sigma, Sigma]


class _GuessPart(PosePart):
    """The initial guess of a LiDAR: its pose, and its sigmas in vehicle axes."""

    sigma_vehicle_axes: _SigmaPart
    fixed: StrictBool = False
    found: StrictBool = False

    def guess(self) -> Guess:
        sigma = self.sigma_vehicle_axes
        sigmas = np.concatenate([np.radians(np.array(sigma.rpy_deg)), np.array(sigma.xyz)])
        return Guess(T_vehicle_lidar=self.pose(), sigmas=sigmas, fixed=self.fixed, found=self.found)


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
    saw_structure: StrictBool = False

    def result(self, has_data: bool) -> LidarResult:
        """The result of the LiDAR; one whose data has information saw the target."""
        offset = self.time_offset
        return LidarResult(
            T_vehicle_lidar=self.T_vehicle_lidar.pose(),
            cov=symmetric(self.covariance),
            determined={axis: getattr(self.determined, axis) for axis in AXES},
            scans_used=self.scans_used,
            saw_target=has_data if self.saw_target is None else self.saw_target,
            time_offset=None if offset is None else (offset.value, offset.sigma),
            guess=None if self.guess is None else self.guess.guess(),
            saw_structure=self.saw_structure,
        )


class _OrderedPart(Part):
    """Vectors and matrices over several LiDARs: six numbers per LiDAR, in this order."""

    order: list[Text] = Field(min_length=1)

    @field_validator("*")
    @classmethod
    def _of_all_lidars(cls, value: Any, info: ValidationInfo) -> Any:
        if info.field_name == "order" and len(set(value)) < len(value):
            raise ValueError("names a LiDAR twice")
        # An order with a problem is missing here, and is reported itself.
        order = info.data.get("order", ())
        size = 6 * len(order)
        if size and info.field_name in ("covariance", "data_information"):
            check_matrix(value, size)
        if size and info.field_name == "data_gradient" and value is not None and len(value) != size:
            raise ValueError(f"must be {size} numbers, has {len(value)}")
        if info.field_name == "T_vehicle_lidar" and not set(order) <= value.keys():
            raise ValueError(f"must have a pose of each of {', '.join(order)}")
        return value


class _EarlierPart(_OrderedPart):
    """What an earlier drive measured."""

    drive_sha256: list[Text]
    T_vehicle_lidar: dict[Text, PosePart]
    data_information: Matrix
    data_gradient: list[Finite]

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


class _SuspectPart(Part):
    """An input that could be wrong."""

    input: Text
    value: list[Finite]
    sigma: list[Finite]
    explains: Finite
    sigmas: Finite
    # Other writers leave these out.
    change: tuple[Finite, ...] = ()
    units: tuple[Text, ...] = ()
    sigmas_left: Finite = 0.0
    determined: tuple[bool, ...] = ()

    def suspect(self) -> Suspect:
        """The same as a product."""
        return Suspect(
            input=self.input,
            value=tuple(self.value),
            sigma=tuple(self.sigma),
            change=tuple(self.change),
            units=tuple(self.units),
            explains=self.explains,
            sigmas=self.sigmas,
            sigmas_left=self.sigmas_left,
            determined=self.determined,
        )


class CalibrationModel(Part):
    """A calibration.yaml."""

    schema_: Schema = Field(alias="schema")
    lidars: Annotated[dict[Text, _LidarPart], Field(min_length=1), AfterValidator(checked_names)]
    joint: _JointPart
    status: Status
    reference: Text
    observability: _ObservabilityPart
    sensor_to_sensor: list[_PairPart] | None = None
    unmet: tuple[Text, ...] = ()
    contradictions: tuple[Text, ...] = ()
    warnings: tuple[Text, ...] = ()
    suspects: tuple[_SuspectPart, ...] = ()
    provenance: dict[Text, Any] = Field({})
    vehicle: VehiclePart = VehiclePart()
    structure: StructurePart | None = None

    @model_validator(mode="after")
    def _knows_all_names(self) -> Self:
        if sorted(self.joint.order) != sorted(self.lidars):
            raise ValueError(
                f"'joint.order': {self.joint.order} must be the LiDARs of the file, "
                f"{list(self.lidars)}"
            )
        directions = (*self.observability.undetermined, *self.observability.weak)
        pairs = self.sensor_to_sensor or ()
        named = {
            "reference": [self.reference],
            "observability": [name for part in directions for name in part.direction],
            "sensor_to_sensor": [name for pair in pairs for name in (pair.from_, pair.to)],
        }
        for place, names in named.items():
            for name in names:
                if name not in self.lidars:
                    known = ", ".join(self.lidars)
                    raise ValueError(f"'{place}': '{name}' is not a LiDAR of the file: {known}")
        return self

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
            warnings=self.warnings,
            suspects=tuple(part.suspect() for part in self.suspects),
            provenance=self.provenance,
            gradient_data=None if gradient is None else np.array(gradient),
            earlier=tuple(part.term() for part in joint.earlier),
            vehicle=self.vehicle.parameters(),
            structure=None if self.structure is None else self.structure.summary(),
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
