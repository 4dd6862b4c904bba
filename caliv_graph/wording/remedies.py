"""What would determine a direction that the data do not determine, by what the drive passes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from caliv_graph.products import Direction, LidarResult

Evidence = Literal["target", "structure", "both", "odometry"]
"""What the LiDARs see: a target, walls and other structure, or both; or structure of a drive that
recorded nothing else."""


@dataclass(frozen=True)
class Remedies:
    """A sentence for each kind of direction.

    Attributes:
        stationary: the vehicle did not move.
        height: the height of all LiDARs together.
        turn_centre: rotation of all LiDARs about the turn centre.
        straight: shift of all LiDARs along or across a straight way.
        tilt: roll and pitch of all LiDARs together.
        apart: LiDARs move apart, mostly in another axis than those that follow.
        apart_z: mostly in z.
        apart_yaw: mostly in yaw.
        more: weakly determined.
    """

    stationary: str
    height: str
    turn_centre: str
    straight: str
    tilt: str
    apart: str
    apart_z: str
    apart_yaw: str
    more: str


def _remedies(
    *, passed: str, in_view: str, apart: str, apart_z: str, apart_yaw: str, more: str
) -> Remedies:
    return Remedies(
        stationary=(
            f"drive past {passed} on a path whose curvature changes, such as a figure-eight"
        ),
        height=(
            "measure the height of the vehicle frame above the ground and set "
            f"ground.vehicle_height and ground.sigma, or cross a ramp while {in_view} in view"
        ),
        turn_centre=(
            f"change the curvature while {in_view} in view: drive an S-curve or a figure-eight, "
            "or add a drive that turns the other way"
        ),
        straight=(
            f"turn while {in_view} in view: an arc determines y and roll, an S-curve or a "
            "figure-eight also x"
        ),
        tilt=(f"turn while {in_view} in view, so that the heading changes, and use the ground"),
        apart=apart,
        apart_z=apart_z,
        apart_yaw=apart_yaw,
        more=f"{more}; better vehicle poses (IMU, GNSS) help too",
    )


_SAME_SIDE = (
    "let these LiDARs see the same side of the target, at any time: pass it in both directions, "
    "as in a figure-eight, or add a second target"
)
_SAME_WALLS = (
    "drive past walls that are not parallel, each seen by all of these LiDARs, at any time: turn, "
    "or pass them in both directions"
)
_SAME_GROUND = (
    "use the ground (ground.use), if all of these LiDARs see it, and on wheels set "
    "ground.vehicle_height, a rough one with a large ground.sigma if need be: upright walls do not "
    "determine z"
)

OF_TARGET = _remedies(
    passed="the target",
    in_view="the target is",
    apart=_SAME_SIDE,
    apart_z=_SAME_SIDE,
    apart_yaw=(
        "use a target without rotational symmetry, such as a chair, and let these LiDARs see the "
        "same side of it: pass it in both directions, or add a second target"
    ),
    more=(
        "pass the target again, closer and at other places, so that each LiDAR sees it in more "
        "scans"
    ),
)

OF_STRUCTURE = _remedies(
    passed="walls that are not parallel",
    in_view="walls are",
    apart=_SAME_WALLS,
    apart_z=_SAME_GROUND,
    apart_yaw=_SAME_WALLS,
    more="drive longer, closer to walls that are not parallel and that each LiDAR sees",
)

OF_BOTH = replace(
    OF_TARGET,
    apart=f"{_SAME_SIDE}; or {_SAME_WALLS}",
    apart_z=f"{_SAME_SIDE}; or {_SAME_GROUND}",
    apart_yaw=f"{OF_TARGET.apart_yaw}; or {_SAME_WALLS}",
)
"""Structure may be no more than the ground: a manoeuvre past the target is what is sure to help."""

_MOTION = "record an IMU with GNSS or velocities, or poses (topics)"
OF_ODOMETRY = replace(
    OF_STRUCTURE,
    stationary=f"drive past walls that are not parallel, and {_MOTION}",
    height=(
        "measure the height of the vehicle frame above the ground and set ground.vehicle_height "
        "and ground.sigma"
    ),
    turn_centre=(
        f"{_MOTION}: without them yaw is the direction of travel, known as well as the vehicle "
        "moves along its x axis, on straights and in curves to both sides"
    ),
    straight=(
        f"measure x and y, or {_MOTION}: without them nothing tells where the vehicle frame has "
        "its origin"
    ),
    tilt=(
        "set ground.parallel_sigma_deg if the vehicle stands parallel to the ground better than "
        f"0.3 degrees, or {_MOTION}"
    ),
)
"""Without motion data no manoeuvre tells S2V."""

TURNED_ALREADY = (
    "; if it does so already, the vehicle's poses are the limit: record better ones (fixes, IMU), "
    "or measure the lever arm better"
)
"""Added to a manoeuvre where a drive determines the direction, but weakly."""

REMEDIES: dict[Evidence, Remedies] = {
    "target": OF_TARGET,
    "structure": OF_STRUCTURE,
    "both": OF_BOTH,
    "odometry": OF_ODOMETRY,
}


_HEIGHT = "measure the height of the vehicle frame above the ground and set ground.vehicle_height "


def with_height_set(direction: Direction, sigma_m: float, stands: bool) -> Direction:
    """A direction whose remedy does not ask for the height of the vehicle, which the config has.

    `stands`: the height is used, as the ground that the vehicle stands on is seen.
    """
    if not direction.remedy.startswith(_HEIGHT):
        return direction
    _, _, manoeuvre = direction.remedy.partition(", or ")
    remedy = (
        f"measure ground.vehicle_height better than its ground.sigma of {1e3 * sigma_m:.3g} mm, "
        "and set both"
    )
    if not stands:
        remedy = (
            "let the LiDARs see the ground that the vehicle drives over, for ground.vehicle_height"
        )
    return replace(direction, remedy=f"{remedy}, or {manoeuvre}" if manoeuvre else remedy)


def evidence_of(lidars: Iterable[LidarResult], odometry: bool = False) -> Evidence:
    """What the LiDARs of a calibration saw, all of them together.

    Args:
        lidars: their results.
        odometry: whether no drive recorded anything else.
    """
    results = tuple(lidars)
    target = any(lidar.saw_target for lidar in results)
    structure = any(lidar.saw_structure for lidar in results)
    if structure and odometry:
        return "odometry"
    if structure:
        return "both" if target else "structure"
    return "target"
