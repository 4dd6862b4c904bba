"""Sentences about structure: walls and other flat surfaces that stand still."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

SPARE_TENTHS = 4.0
"""Decimetres beyond the middle of the farthest piece of the vehicle: half a piece, and rounding."""


def no_target_sentence(what: str) -> str:
    """The warning of a run without a target; `what` says why there is none."""
    return f"calibrated without a target, by walls and other structure alone: {what}"


def wrong_target_sentence(contradiction: str) -> str:
    """Why the object that the search found is not used; what its clouds say."""
    return (
        f"the object that was found for a target is none: {contradiction}. To use a target, give "
        "its region (target.min, max)"
    )


def left_out_sentence(contradiction: str) -> str:
    """The warning that a LiDAR's clouds of the target are not used; what they say."""
    return (
        f"{contradiction}, and walls do not: these clouds are not used. They may be of another "
        "object, or too sparse to be laid on the target"
    )


def deskewed_sentence(told: Mapping[str, tuple[float, float, int]], others: Sequence[str]) -> str:
    """The warning that clouds are taken as deskewed before they were recorded.

    By LiDAR the share of the motion that is left in them, its sigma, and the scans that tell;
    `others` are LiDARs that do not tell, and are taken likewise.
    """
    of = " and ".join(
        f"'{name}' ({share:.2f} +- {sigma:.2f} of the motion is left, in {scans} scans)"
        for name, (share, sigma, scans) in told.items()
    )
    too = f", and {' and '.join(map(repr, others))}, which does not tell," if others else ""
    return (
        f"the clouds of lidar {of}{too} were deskewed before they were recorded: where the end of "
        "a sweep meets its beginning, walls fit as they are. The times of points are not used, and "
        "all points are taken as of the stamp. Set lidars.<name>.deskewed: true for other "
        "commands, or false if they were not"
    )


def nothing_sentence(what: str, structure: str) -> str:
    """The error where neither target nor structure tells anything; why, of each."""
    return f"{what}. Structure does not replace it: {structure}"


def ranges_sentence(ranges_m: Mapping[str, tuple[float, float]]) -> str:
    """What to do about range limits (least, most) that leave LiDARs little of what they see."""
    told = " and ".join(f"'{name}' {a:g} to {b:g} m" for name, (a, b) in ranges_m.items())
    return (
        f"Range limits drop most of what there is to see: of lidars {told} is used (min_range, "
        "max_range). Widen them"
    )


def standing_sentence(moved_m: float, turned_deg: float, lasts_s: float) -> str:
    """What to do where a vehicle stood: how far it moved and turned, and in how long, at most."""
    return (
        f"The vehicle stands: it moves {moved_m:.2f} m and turns {turned_deg:.1f} degrees in "
        f"{lasts_s:.1f} s. Record a drive past the target or walls, or, of LiDARs with a common "
        "view, a target that is carried to several places"
    )


def rough_ground_sentence(
    roughness_m: Mapping[str, float],
    stated_m: float | None,
    used_m: float,
    seen: tuple[float, float],
) -> str:
    """The warning that the ground seen may not be what carries the wheels.

    `roughness_m` is that of each drive with such ground, by its name; `stated_m` 1 sigma of the
    height as stated, None if no height is; `used_m` in its place; `seen` that of the tilt and the
    height in which each LiDAR sees the ground, rad and metres.
    """
    drives = ", ".join(roughness_m)
    scatter = " and ".join(f"{1e3 * of:.0f}" for of in roughness_m.values())
    height, better = "", "roll and pitch"
    if stated_m is not None:
        height = (
            f"ground.vehicle_height is believed to {1e3 * used_m:.0f} mm in place of ground.sigma "
            f"({1e3 * stated_m:.3g} mm), and z of all LiDARs with it; "
        )
        better = "roll, pitch and z"
    return (
        f"{drives}: the ground scatters by {scatter} mm from point to point, as grass "
        f"or gravel does: LiDARs see its tips, wheels sink in. {height}each LiDAR's ground is "
        f"believed to {1e3 * seen[0]:.2f} mrad of tilt and {1e3 * seen[1]:.1f} mm of height, in "
        f"all drives. For {better} use drives on asphalt or concrete alone"
    )


def own_body_sentence(lidar: str, share: float, reach_m: float) -> str:
    """The warning that a LiDAR sees the vehicle; part of its flat pieces, and how far away."""
    enough_m = math.floor(10.0 * reach_m + SPARE_TENTHS) / 10.0
    return (
        f"lidar '{lidar}' sees the vehicle itself: {100.0 * share:.2g} % of its flat pieces are "
        f"level ones up to {reach_m:.1f} m away that move with it, well above the ground. They are "
        "left out of walls and ground; other stages still have the points. Set "
        f"lidars.{lidar}.min_range to {enough_m:.1f} m or to what is beyond the vehicle"
    )


def shared_walls_sentence(a: str, b: str, strips: int, walls: Sequence[str] = ()) -> str:
    """How many strips of walls two LiDARs both see, and what follows if there are none."""
    if not strips:
        return (
            f"LiDARs '{a}' and '{b}' see no piece of a wall that the other sees, at any time: "
            "walls do not tie them to each other"
        )
    return f"LiDARs '{a}' and '{b}' both see {strips} pieces of {', '.join(walls) or 'walls'}"
