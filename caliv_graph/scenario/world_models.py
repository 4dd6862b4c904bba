"""Ground, objects and people that a scenario can describe, as frozen pydantic models.

The units stand in the `Field` descriptions. `terrain` and `world` compute heights and meshes from
these models.
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from caliv_graph.config.sections import Finite, NonNegative, Positive, PositiveTriple, Section
from caliv_graph.scenario.drive_models import Pair


class RampModel(Section):
    """A smooth rise of the ground: up a flank, a level top, down a flank.

    The steepest place of a flank has a slope of 35/16 height_m / flank_m.
    """

    xy_m: Pair = Field(description="metres, middle of its top in the map")
    yaw_deg: Finite = Field(0.0, description="degrees, direction of its flanks, from map +x")
    height_m: Positive = Field(description="metres from the ground to the top")
    flank_m: Positive = Field(description="metres, horizontal length of each flank")
    top_m: NonNegative = Field(0.0, description="metres, length of the level top")
    width_m: Positive = Field(
        6.0, description="metres, width of the level top; it has flanks on these two sides too"
    )


class GroundModel(Section):
    """Flat ground, a square about the map's origin, with ramps or waves on it.

    The vehicle follows ramps and waves. Bumps are only what the LiDARs see.
    """

    height_m: Finite = Field(0.0, description="metres, its z in the map")
    half_size_m: Positive = Field(200.0, description="metres from the origin to each edge")
    ramps: tuple[RampModel, ...] = Field((), description="absent: flat all over")
    bumps_sigma_m: NonNegative = Field(
        0.0, description="metres, 1 sigma of its height at the corners of its cells; 0: flat"
    )
    bumps_cell_m: Positive = Field(2.0, description="metres, side of a cell")
    bumps_seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of its bumps")
    waves_sigma_m: NonNegative = Field(
        0.0,
        description="metres, 1 sigma of its height by waves of 10 to 40 m; 0: none. A road of "
        "class A (ISO 8608) has 0.0022",
    )
    waves_seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of its waves")

    @model_validator(mode="after")
    def _bumps_or_followed(self) -> GroundModel:
        if self.bumps_sigma_m > 0.0 and (self.ramps or self.waves_sigma_m > 0.0):
            raise ValueError(
                "ground: it has bumps (bumps_sigma_m above 0), or ramps and waves, not both"
            )
        return self


class MoveModel(Section):
    """A person carries an object to another place. The person is absent between moves."""

    begin_s: NonNegative = Field(description="seconds since the start of the drive, picked up")
    end_s: Positive = Field(description="seconds since the start of the drive, put down")
    xy_m: Pair = Field(description="metres, its new origin in the map")
    yaw_deg: Finite = Field(0.0, description="degrees, its +x from map +x at the new place")

    @model_validator(mode="after")
    def _takes_time(self) -> MoveModel:
        if self.begin_s >= self.end_s:
            raise ValueError(f"begin_s ({self.begin_s} s) must be before end_s ({self.end_s} s)")
        return self


class _ObjectSection(Section):
    xy_m: Pair = Field(description="metres, its origin in the map; it stands on the ground")
    yaw_deg: Finite = Field(0.0, description="degrees, its +x (a chair's front) from map +x")
    moves: tuple[MoveModel, ...] = Field(
        (), description="where it is carried, one after the other; absent: it stands all the time"
    )

    @model_validator(mode="after")
    def _one_move_after_the_other(self) -> _ObjectSection:
        for before, after in itertools.pairwise(self.moves):
            if before.end_s > after.begin_s:
                raise ValueError(
                    f"moves: one begins at {after.begin_s} s, before the one at "
                    f"{before.begin_s} s has ended"
                )
        return self


class ChairModel(_ObjectSection):
    """The plastic armchair of `shapes.chair`: 0.71 m wide, 0.77 m deep, 1.25 m high."""

    shape: Literal["chair"] = "chair"


class ThinChairModel(_ObjectSection):
    """A chair of legs of 4 x 4 cm and slats of 2 x 5 cm: 0.6 m wide, 0.6 m deep, 0.95 m high."""

    shape: Literal["thin_chair"] = "thin_chair"


class BoxesModel(_ObjectSection):
    """Three cardboard boxes, two side by side and one on top: 0.65 x 1.07 x 0.65 m."""

    shape: Literal["boxes"] = "boxes"


class ConesModel(_ObjectSection):
    """Three traffic cones and a bag that lies beside them: 0.78 x 1.13 x 0.75 m."""

    shape: Literal["cones"] = "cones"


class BicycleModel(_ObjectSection):
    """A bicycle that stands upright: 1.7 m long, 0.6 m wide, 1.02 m high."""

    shape: Literal["bicycle"] = "bicycle"


class StrollerModel(_ObjectSection):
    """A pram with a seat and a hood of cloth: 0.97 m long, 0.58 m wide, 1.05 m high."""

    shape: Literal["stroller"] = "stroller"


class BinModel(_ObjectSection):
    """A kerbside bin, its wheels and handle behind: 0.74 m deep, 0.58 m wide, 1.07 m high."""

    shape: Literal["bin"] = "bin"


class BoxModel(_ObjectSection):
    """A box. A long flat one is a wall."""

    shape: Literal["box"] = "box"
    size_m: PositiveTriple = Field(description="metres along its x, y, z")


class PoleModel(_ObjectSection):
    """An upright round pole."""

    shape: Literal["pole"] = "pole"
    radius_m: Positive = Field(0.08, description="metres")
    height_m: Positive = Field(4.0, description="metres")


class CylinderModel(_ObjectSection):
    """A drum. It is symmetric about its axis: its mesh has 360 sides, a pole's has 24."""

    shape: Literal["cylinder"] = "cylinder"
    radius_m: Positive = Field(0.3, description="metres")
    height_m: Positive = Field(0.9, description="metres")


class TableModel(_ObjectSection):
    """A table on four legs. It is symmetric under half a turn only."""

    shape: Literal["table"] = "table"
    size_m: PositiveTriple = Field((1.1, 0.7, 0.72), description="metres along its x, y, z")
    top_m: Positive = Field(0.04, description="metres, thickness of its top")
    leg_m: Positive = Field(0.07, description="metres, side of its square legs")

    @model_validator(mode="after")
    def _legs_below_the_top(self) -> TableModel:
        if self.top_m >= self.size_m[2] or 2.0 * self.leg_m > min(self.size_m[:2]):
            raise ValueError(
                f"size_m {self.size_m} leaves no room for a top of {self.top_m} m and legs of "
                f"{self.leg_m} m"
            )
        return self


class RevealsModel(Section):
    """Windows in both faces of a wall, in one row, set back from the face."""

    size_m: tuple[Positive, Positive] = Field((1.2, 1.4), description="metres, width and height")
    spacing_m: Positive = Field(3.0, description="metres between the middles of two windows")
    sill_m: Positive = Field(0.9, description="metres from the ground to their lower edge")
    depth_m: tuple[Positive, Positive] = Field(
        (0.05, 0.2), description="metres, least and largest depth; drawn for each window"
    )

    @model_validator(mode="after")
    def _apart(self) -> RevealsModel:
        if self.spacing_m <= self.size_m[0]:
            raise ValueError(
                f"spacing_m ({self.spacing_m} m) must exceed the width of {self.size_m[0]} m"
            )
        if self.depth_m[0] > self.depth_m[1]:
            raise ValueError(f"depth_m: {self.depth_m[0]} m must not exceed {self.depth_m[1]} m")
        return self


class WallModel(_ObjectSection):
    """A wall along its x axis. Neither face is flat: both have bumps of their own.

    A bump is an offset of the face at the corner of a cell. Between corners it is interpolated.
    """

    shape: Literal["wall"] = "wall"
    length_m: Positive = Field(description="metres along its x")
    height_m: Positive = Field(3.0, description="metres")
    thickness_m: Positive = Field(0.3, description="metres along its y")
    bumps_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma of a face's offset at the corners of its cells; 0: flat"
    )
    bumps_cell_m: tuple[Positive, Positive] = Field(
        (1.0, 2.0), description="metres, least and largest side of a cell; drawn for each row"
    )
    reveals: RevealsModel | None = Field(None, description="windows; absent: none")
    seed: Annotated[int, Field(ge=0)] = Field(
        0, description="seed of its bumps and of the depths of its windows"
    )

    @model_validator(mode="after")
    def _holds_its_windows(self) -> WallModel:
        if self.bumps_cell_m[0] > self.bumps_cell_m[1]:
            low, high = self.bumps_cell_m
            raise ValueError(f"bumps_cell_m: {low} m must not exceed {high} m")
        deep_m = 0.0 if self.reveals is None else self.reveals.depth_m[1]
        # Six sigma on either side: the faces never meet.
        if self.thickness_m <= 2.0 * deep_m + 12.0 * self.bumps_sigma_m:
            raise ValueError(
                f"thickness_m ({self.thickness_m} m) must exceed twice the depth of a window "
                f"({deep_m} m) and six bumps_sigma_m ({self.bumps_sigma_m} m)"
            )
        if self.reveals is not None:
            top_m = self.reveals.sill_m + self.reveals.size_m[1]
            if top_m >= self.height_m or self.reveals.size_m[0] >= self.length_m:
                raise ValueError(
                    f"a wall of {self.length_m} m x {self.height_m} m is too small for windows of "
                    f"{self.reveals.size_m[0]} m up to a height of {top_m} m: make it larger, or "
                    "lower reveals.sill_m or reveals.size_m"
                )
        return self


class KerbModel(_ObjectSection):
    """A kerbstone along its x axis; its sides lean by 10 mm."""

    shape: Literal["kerb"] = "kerb"
    length_m: Positive = Field(description="metres along its x")
    height_m: Positive = Field(0.12, description="metres")
    width_m: Positive = Field(0.15, description="metres along its y")


class CarModel(_ObjectSection):
    """A parked car, 4.3 m long, 1.8 m wide, 1.45 m high. Its sides are slightly curved."""

    shape: Literal["car"] = "car"


class _FoliageSection(_ObjectSection):
    leaf_m: Positive = Field(0.12, description="metres, side of a leaf, a triangle")
    penetration_m: Positive = Field(
        0.2, description="metres, mean depth to which a beam enters before it hits a leaf"
    )
    seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of its leaves")


class HedgeModel(_FoliageSection):
    """A hedge: a box full of leaves, whose surface is uneven by the depth that beams enter."""

    shape: Literal["hedge"] = "hedge"
    size_m: PositiveTriple = Field((6.0, 0.8, 1.6), description="metres along its x, y, z")


class BushModel(_FoliageSection):
    """A bush: an ellipsoid full of leaves, on the ground."""

    shape: Literal["bush"] = "bush"
    size_m: PositiveTriple = Field((1.5, 1.5, 1.4), description="metres along its x, y, z")


ObjectModel = Annotated[
    ChairModel
    | ThinChairModel
    | BoxesModel
    | ConesModel
    | BicycleModel
    | StrollerModel
    | BinModel
    | BoxModel
    | PoleModel
    | CylinderModel
    | TableModel
    | WallModel
    | KerbModel
    | CarModel
    | HedgeModel
    | BushModel,
    Field(discriminator="shape"),
]


class WalkerModel(Section):
    """A person, 1.75 m tall, who walks back and forth along a line, or a car that drives so.

    A car turns at the ends within no time.
    """

    body: Literal["person", "car"] = Field("person", description="what moves")
    from_xy_m: Pair = Field(description="metres, one end of the line in the map")
    to_xy_m: Pair = Field(description="metres, the other end")
    speed_m_s: Positive = Field(1.3, description="metres per second")

    @model_validator(mode="after")
    def _somewhere_to_go(self) -> WalkerModel:
        if math.dist(self.from_xy_m, self.to_xy_m) < 0.1:
            raise ValueError(
                f"from_xy_m and to_xy_m are {math.dist(self.from_xy_m, self.to_xy_m):.2f} m apart, "
                "must be 0.1 m or more"
            )
        return self


class WorldModel(Section):
    """Everything around the drive."""

    ground: GroundModel = GroundModel()
    objects: dict[str, ObjectModel] = Field({}, description="objects, by name")
    walkers: dict[str, WalkerModel] = Field(
        {}, description="people who walk and cars that drive, by name"
    )
    targets: tuple[str, ...] = Field(
        (), description="names of the objects that serve as calibration targets"
    )
    region_margin_m: Positive = Field(
        5.0,
        description="metres around each target that the region in the written config includes",
    )

    @model_validator(mode="after")
    def _targets_are_objects(self) -> WorldModel:
        for name in self.targets:
            if name not in self.objects:
                raise ValueError(
                    f"target '{name}' is not one of the objects: name one of "
                    f"{', '.join(self.objects)}"
                )
        for name in self.walkers:
            if name in self.objects:
                raise ValueError(f"'{name}' is the name of an object and of a walker: rename one")
        for name in (*self.objects, *self.walkers):
            if name in ("ground", "vehicle"):
                raise ValueError(f"'{name}' is the name of something else: give another one")
        return self


class BodyBoxModel(Section):
    """A box that is part of the vehicle."""

    centre_m: tuple[Finite, Finite, Finite] = Field(description="metres, vehicle frame")
    size_m: PositiveTriple = Field(description="metres along the vehicle's x, y, z")
