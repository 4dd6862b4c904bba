"""Suggests a drive that meets the limits in the smallest space, from a small set of manoeuvres.

Each manoeuvre is predicted with the scenario's own vehicle and sensors. Its first target is placed
at a few positions beside the path. The candidates are tried in the order of the space they need,
and the first one that meets the limits is returned.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from caliv_graph.config.model import LIMIT_KEY
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import CalivError, ConfigError
from caliv_graph.planning.assumptions import Assumptions
from caliv_graph.planning.predict import Prediction, SeenDrive, predict_seen, sigma_of, space
from caliv_graph.scenario.drive_models import ArcDrive, DriveModel, FigureEightDrive, SCurveDrive
from caliv_graph.scenario.drives import Drive, make_drive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.scenario.world_models import RampModel

DEFAULT_RADIUS_M = 9.16
DEFAULT_SPEED_M_S = 2.0
"""Radius and speed of the paper's drive, for a scenario that has none (standstill, straight)."""

ARC_RAD = math.radians(210.0)
"""Angle of an arc, large enough for LiDARs to the front and to the rear to see the target."""

S_RAD = math.radians(120.0)
"""Angle of each half of an S-curve."""

BESIDE_M = (4.0, 6.0)
"""Distances of the target from the path."""

ALONG = (0.35, 0.5, 0.65)
"""Fractions of the path at which the target may stand beside it."""

CLEAR_M = 3.0
"""Smallest distance of the target from the path, so that the vehicle can pass."""

STRIDE = 4
QUICK_TOLERANCE = 0.1
"""A quick prediction uses every fourth cloud with fourfold weight; its relative error but for the
ground: planes of scans have a quarter of the S2S roll of cells, which the full one finds."""

RAMP_HEIGHT_M = 0.25
RAMP_FLANK_M = 4.0
"""A ramp such as a dropped kerb or two boards on bricks: 7.8 degrees at most."""


@dataclass(frozen=True)
class Suggestion:
    """A drive that meets the limits, or the one nearest to them.

    Attributes:
        manoeuvre: the manoeuvre in words.
        scenario: the same as a scenario, ready to be simulated or planned.
        prediction: its prediction, together with the drives that there are already.
        met: whether it meets the limits.
        worst: largest ratio of a predicted sigma to its limit, at most 1 if all limits are met.
            Without limits, the number of undetermined directions.
        space_m: sides of the rectangle around its path and target.
    """

    manoeuvre: str
    scenario: Scenario
    prediction: Prediction
    met: bool
    worst: float
    space_m: tuple[float, float]


@dataclass(frozen=True)
class Planned:
    """The drives that are asked about, and what a suggestion starts from.

    Attributes:
        prediction: of all of them together; None: recorded ones that show no target, alone.
        vehicle: vehicle, sensors, and the target to place (the first).
        assumptions: how drives will be recorded and calibrated.
        recorded: drives of the vehicle that there are already, each with a target.
        lidars: as a recording showed them, by name; empty: a scenario states them.
        notes: for the user, a line each.
    """

    prediction: Prediction | None
    vehicle: Scenario
    assumptions: Assumptions
    recorded: Sequence[SeenDrive] = ()
    lidars: Mapping[str, LidarModel] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def parse_goals(items: Sequence[str]) -> dict[str, float]:
    """Limits of sigmas from the command line.

    Args:
        items: `s2v_yaw_deg=0.05` and the like.

    Raises:
        ConfigError: an item has another form.
    """
    goals: dict[str, float] = {}
    for item in items:
        key, equals, text = item.partition("=")
        if not equals or not LIMIT_KEY.match(key):
            raise ConfigError(
                f"--sigma {item}: expected KEY=VALUE, KEY being s2s_ or s2v_, then roll_deg, "
                "pitch_deg, yaw_deg, x_m, y_m or z_m: s2v_yaw_deg=0.05"
            )
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError(
                f"--sigma {item}: '{text}' is not a number above zero, expected such as 0.05"
            )
        if key in goals:
            raise ConfigError(f"--sigma {item}: {key} is given twice. Remove one")
        goals[key] = value
    return goals


def shortfall(prediction: Prediction, goals: Mapping[str, float]) -> float:
    """Ratio of a prediction to its limits.

    Args:
        prediction: prediction of a drive.
        goals: limit as in a config (`s2v_yaw_deg`) -> largest sigma; empty: no direction may be
            undetermined.

    Returns:
        The largest ratio of a sigma to its limit, infinite if a LiDAR sees no target; without goals
        the number of undetermined directions.
    """
    if prediction.covariance.unseeing:
        return math.inf
    if not goals:
        return float(len(prediction.undetermined))
    return max(
        value / limit
        for key, limit in goals.items()
        for value in (sigma_of(prediction, key) or {"": 0.0}).values()
    )


def is_met(worst: float, goals: Mapping[str, float]) -> bool:
    """Whether a `shortfall` meets the goals."""
    return worst <= 1.0 if goals else worst == 0.0


def suggest(
    scenario: Scenario,
    goals: Mapping[str, float],
    assumptions: Assumptions,
    beside: Sequence[SeenDrive] = (),
) -> Suggestion | None:
    """The manoeuvre that meets the goals in the smallest space, or the one nearest to them.

    Args:
        scenario: vehicle, sensors, and the target to place (the first).
        goals: as for `shortfall`.
        assumptions: how drives will be recorded and calibrated.
        beside: drives of the vehicle that there are already; it is solved together with them.

    Returns:
        None if no LiDAR sees the target in any of them, or if there is none to place.
    """
    if not scenario.world.targets:
        return None
    best: Suggestion | None = None
    with_ramp = assumptions.ground != "height"
    quickly = replace(assumptions, stride=STRIDE)
    # Walls of a recording are no part of its scenario; a drive tells the same beside any other.
    beside_quickly = [
        of if of.structure is not None else SeenDrive.of(of.scenario, of.drive, quickly)
        for of in beside
    ]
    for tried in sorted(candidates(scenario, with_ramp, both_turns=bool(beside)), key=_cost):
        quick = _tried(tried, goals, quickly, beside_quickly)
        if quick is None:
            continue
        if quick.met or (goals and quick.worst <= 1.0 + QUICK_TOLERANCE):
            found = _tried(tried, goals, assumptions, beside)
            if found is not None:
                if found.met:
                    return found
                quick = found
        if best is None or quick.worst < best.worst:
            best = quick
    return best and (_tried((best.manoeuvre, best.scenario), goals, assumptions, beside) or best)


def _tried(
    candidate: tuple[str, Scenario],
    goals: Mapping[str, float],
    assumptions: Assumptions,
    beside: Sequence[SeenDrive],
) -> Suggestion | None:
    """A candidate with its prediction; None if no LiDAR sees the target."""
    manoeuvre, scenario = candidate
    drive = make_drive(scenario.drive, make_terrain(scenario.world.ground))
    try:
        own = SeenDrive.of(scenario, drive, assumptions)
        prediction = predict_seen([*beside, own], assumptions)
    except CalivError:
        return None
    worst = shortfall(prediction, goals)
    met = is_met(worst, goals)
    return Suggestion(manoeuvre, scenario, prediction, met, worst, space([(scenario, drive)]))


def _cost(candidate: tuple[str, Scenario]) -> tuple[float, float]:
    """Area of the rectangle around path and target, then the duration."""
    scenario = candidate[1]
    drive = make_drive(scenario.drive)
    x, y = space([(scenario, drive)])
    return (round(x * y, 1), drive.duration_s)


def candidates(
    scenario: Scenario, with_ramp: bool = False, both_turns: bool = False
) -> Iterator[tuple[str, Scenario]]:
    """The manoeuvres and target placements to try, in words and as scenarios.

    Args:
        scenario: vehicle, sensors, and the target to place (the first).
        with_ramp: also over a ramp, which makes the height observable without the ground.
        both_turns: arcs to either side: two of them change the curvature.

    Raises:
        ConfigError: the scenario has no target.
    """
    if not scenario.world.targets:
        raise ConfigError(
            f"scenario '{scenario.name}': world.targets names no target to place: add one"
        )
    for words, model in _manoeuvres(scenario, both_turns):
        drive = make_drive(model)
        ramps: list[tuple[str, tuple[RampModel, ...]]] = [("", ())]
        if with_ramp and not isinstance(model, ArcDrive):
            ramps.append((" over a ramp", (_ramp(drive),)))
        for over, ramp in ramps:
            for beside_m, xy_m in _places(drive):
                text = f"{words}{over}, target {beside_m:.0f} m beside the path at {_place(xy_m)}"
                yield text, _placed(scenario, model, ramp, xy_m)


def _place(xy_m: tuple[float, float]) -> str:
    return f"({xy_m[0]:.1f}, {xy_m[1]:.1f}) m from the start, x ahead and y left"


def _manoeuvres(scenario: Scenario, both_turns: bool) -> Iterator[tuple[str, DriveModel]]:
    given = scenario.drive
    radius_m = float(getattr(given, "radius_m", DEFAULT_RADIUS_M))
    speed = float(getattr(given, "speed_m_s", DEFAULT_SPEED_M_S))
    kept: dict[str, Any] = {
        "start_xy_m": (0.0, 0.0),
        "start_yaw_deg": 0.0,
        "speed_m_s": speed,
        "radius_m": radius_m,
        "turn": getattr(given, "turn", "right"),
    }
    for name in ("standstill_s", "ramp_s", "wheelbase_m"):
        if hasattr(given, name):
            kept[name] = getattr(given, name)
    still = ArcDrive(duration_s=1e3, **kept)
    rest_s = still.standstill_s + still.ramp_s
    arc_s = rest_s + ARC_RAD * radius_m / speed
    s_s = rest_s + 2.0 * S_RAD * radius_m / speed
    for turn in ("right", "left") if both_turns else (kept["turn"],):
        side = f" to the {turn}" if both_turns else ""
        yield (
            f"arc{side} of radius {radius_m:.1f} m by {math.degrees(ARC_RAD):.0f} degrees, "
            f"{arc_s:.0f} s",
            ArcDrive(duration_s=round(arc_s, 1), **{**kept, "turn": turn}),
        )
    yield (
        f"S-curve of radius {radius_m:.1f} m, {math.degrees(S_RAD):.0f} degrees each way, "
        f"{s_s:.0f} s",
        SCurveDrive(duration_s=round(s_s, 1), **kept),
    )
    eight = FigureEightDrive(**kept)
    eight_s = make_drive(eight).duration_s
    yield f"figure-eight of radius {radius_m:.1f} m, {eight_s:.0f} s", eight


def _path(drive: Drive, count: int = 400) -> tuple[Any, Any]:
    """(n, 2) positions and (n,) headings along the path, evenly in time."""
    stamps = np.linspace(0.0, drive.duration_s * NANOSECONDS_PER_SECOND, count).astype(np.int64)
    motion = drive.motion(stamps)
    return motion.xy_map, motion.heading_rad


def _places(drive: Drive) -> Iterator[tuple[float, tuple[float, float]]]:
    """Positions of the target beside the path at which the vehicle can pass."""
    xy, heading = _path(drive)
    seen: set[tuple[float, float]] = set()
    for part in ALONG:
        at = int(part * (len(xy) - 1))
        left = np.array([-math.sin(heading[at]), math.cos(heading[at])])
        for beside_m in BESIDE_M:
            for side in (-1.0, 1.0):
                place = xy[at] + side * beside_m * left
                if np.linalg.norm(xy - place, axis=1).min() < CLEAR_M:
                    continue
                key = (round(float(place[0]), 1), round(float(place[1]), 1))
                if key not in seen:
                    seen.add(key)
                    yield beside_m, key


def _ramp(drive: Drive) -> RampModel:
    """A ramp across the path at a third of the drive's duration."""
    xy, heading = _path(drive)
    at = len(xy) // 3
    return RampModel(
        xy_m=(round(float(xy[at, 0]), 1), round(float(xy[at, 1]), 1)),
        yaw_deg=round(math.degrees(heading[at]), 0),
        height_m=RAMP_HEIGHT_M,
        flank_m=RAMP_FLANK_M,
        top_m=1.0,
    )


def _placed(
    scenario: Scenario, drive: DriveModel, ramps: Sequence[RampModel], xy_m: tuple[float, float]
) -> Scenario:
    """The scenario with another drive and only its first target, at another place."""
    name = scenario.world.targets[0]
    target = scenario.world.objects[name].model_copy(update={"xy_m": xy_m})
    if hasattr(target, "moves"):
        target = target.model_copy(update={"moves": ()})
    world = scenario.world.model_copy(
        update={
            "objects": {name: target},
            "targets": (name,),
            "walkers": {},
            "ground": scenario.world.ground.model_copy(update={"ramps": tuple(ramps)}),
        }
    )
    gnss = scenario.gnss.model_copy(update={"outages": (), "jumps": ()})
    return scenario.model_copy(
        update={"name": "suggestion", "drive": drive, "world": world, "gnss": gnss}
    )
