"""The drives that a scenario can describe, as frozen pydantic models.

The units stand in the `Field` descriptions. `drives` computes poses from these models.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from caliv_graph.config.sections import Finite, NonNegative, Positive, Section

Pair = tuple[Finite, Finite]
Turn = Literal["left", "right"]


class _DriveSection(Section):
    """Common to all drives. The vehicle frame is on the ground at the rear axle."""

    start_xy_m: Pair = Field((0.0, 0.0), description="metres, start in the map")
    start_yaw_deg: Finite = Field(0.0, description="degrees, heading at the start, from map +x")


class _MovingSection(_DriveSection):
    speed_m_s: Positive = Field(
        2.0, description="metres per second, of the rear axle, once rolling"
    )
    standstill_s: NonNegative = Field(1.0, description="seconds before the vehicle starts to roll")
    ramp_s: Positive = Field(
        1.5, description="seconds from standstill to speed_m_s, and back at the end"
    )
    wheelbase_m: Positive = Field(2.8, description="metres between the axles")


class _TimedSection(_MovingSection):
    duration_s: Positive = Field(description="seconds, from the first scan to standing again")

    @model_validator(mode="after")
    def _time_to_start_and_stop(self) -> _TimedSection:
        least = self.standstill_s + 2.0 * self.ramp_s
        if self.duration_s < least:
            raise ValueError(
                f"duration_s ({self.duration_s} s) leaves no time to start and stop: "
                f"it must be at least standstill_s + 2 ramp_s, {least} s"
            )
        return self


class _TransitionSection(Section):
    transition_m: Positive = Field(
        3.0, description="metres of path over which the curvature changes"
    )


class ArcDrive(_TimedSection):
    """One arc with the steering set before the vehicle starts: the paper's drive."""

    kind: Literal["arc"] = "arc"
    radius_m: Positive = Field(9.16, description="metres, turning radius of the rear axle")
    turn: Turn = Field("right", description="side to which the vehicle turns")


class SCurveDrive(_TimedSection, _TransitionSection):
    """An arc to one side for half of the path, then one to the other side."""

    kind: Literal["s_curve"] = "s_curve"
    radius_m: Positive = Field(9.16, description="metres, turning radius of the rear axle")
    turn: Turn = Field("right", description="side to which the vehicle turns first")


class FigureEightDrive(_MovingSection, _TransitionSection):
    """A full circle, then a full circle to the other side. The radius sets the duration."""

    kind: Literal["figure_eight"] = "figure_eight"
    radius_m: Positive = Field(9.16, description="metres, turning radius of the rear axle")
    turn: Turn = Field("right", description="side to which the vehicle turns first")


class StraightDrive(_TimedSection):
    """Straight ahead."""

    kind: Literal["straight"] = "straight"


class StandstillDrive(_DriveSection):
    """The vehicle does not move."""

    kind: Literal["standstill"] = "standstill"
    duration_s: Positive = Field(description="seconds")


DriveModel = Annotated[
    ArcDrive | SCurveDrive | FigureEightDrive | StraightDrive | StandstillDrive,
    Field(discriminator="kind"),
]
