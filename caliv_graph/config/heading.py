"""Heading by two antennas: where their baseline is on the vehicle."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from caliv_graph.config.sections import Finite, Place, Positive, Section

HeadingAxes = Literal["enu", "ned"]


class HeadingConfig(Section):
    """The source of `topics.heading`: an angle, or the fixes of a second antenna."""

    yaw_deg: Finite = Field(
        0.0,
        description="degrees, direction in the vehicle frame that the heading is of, to the left: "
        "0 ahead, 90 to the left",
    )
    sigma_deg: Positive = Field(1.0, description="degrees, how far off that may be, 1 sigma")
    axes: HeadingAxes = Field(
        "enu",
        description="enu: the yaw counts from east to the left, as in ROS; ned: from north to the "
        "right, as receivers count it",
    )
    lever_arm: Place | None = Field(
        None, description="metres, the second antenna in the vehicle frame, if its fixes are given"
    )
    lever_arm_sigma: Positive = Field(
        0.01, description="metres, sigma of it per axis, against that of topics.gnss"
    )

    @property
    def yaw_rad(self) -> float:
        """`yaw_deg` in radians."""
        return math.radians(self.yaw_deg)
