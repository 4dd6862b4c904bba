"""A vehicle and its drive from a recording, for the prediction of the next drive."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import gtsam
import numpy as np

from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS, configured_guess
from caliv_graph.config.model import Config
from caliv_graph.config.range_errors import range_errors
from caliv_graph.errors import ConfigError, RecordingError, TrajectoryError
from caliv_graph.pipeline import Look, look
from caliv_graph.planning.assumptions import Assumptions
from caliv_graph.planning.predict import SeenDrive, predict_seen
from caliv_graph.planning.recorded_lidar import SeenBeams, lidar_model
from caliv_graph.planning.recorded_motion import RecordedMotion, lifted, recorded_motion
from caliv_graph.planning.recorded_route import RecordedRoute
from caliv_graph.planning.recorded_target import nearest_object, silhouettes
from caliv_graph.planning.recorded_walls import RecordedWalls
from caliv_graph.planning.suggest import DEFAULT_RADIUS_M, DEFAULT_SPEED_M_S, Planned
from caliv_graph.products import IntArray, Recording
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.drives import Route, make_drive
from caliv_graph.scenario.model import (
    UNIFORM_TO_SIGMA,
    InitialGuessModel,
    Scenario,
    SuspensionModel,
)
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.scenario.world_models import ChairModel, GroundModel, ObjectModel, WorldModel
from caliv_graph.targets.ground.guesses import lidar_grounds
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.wording.recorded import (
    INSTEAD,
    height_sentence,
    no_target_sentence,
    target_sentence,
    unknown_height_sentence,
    walls_sentence,
)
from caliv_graph.workflows.recorded_walls import SolvedWalls, solved_walls, uses_walls

SCANS = 12
"""Clouds of a LiDAR from which its beams are read: half of them of those that see a target."""

RADII_M = (3.0, 30.0)
"""Turning radii that a suggested manoeuvre may have: the tightest of the recorded drive between
those of a small robot and of a wide place. Beyond, the drive was straight."""

LEAST_SUGGESTED_S = 10.0
"""Duration of the arc that stands for the vehicle's way of driving in its scenario."""


@dataclass(frozen=True)
class RecordedDrive:
    """A recorded drive that can be predicted, and its vehicle.

    Attributes:
        scenario: the vehicle with its sensors, and the targets that were found; its `drive` is an
            arc as the vehicle can drive it.
        route: the drive.
        assumptions: how the config calibrates it.
        vehicle: the same on level ground, with a chair if no target was found: for suggestions.
        sees_target: whether there is a target to predict with.
        walls: those that it passes; None: none, or they are not used.
        notes: for the user, a line each.
    """

    scenario: Scenario
    route: Route
    assumptions: Assumptions
    vehicle: Scenario
    sees_target: bool
    notes: tuple[str, ...]
    walls: RecordedWalls | None = None

    @property
    def tells(self) -> bool:
        """Whether there is anything to predict with."""
        return self.sees_target or self.walls is not None

    def mounted_as(self, others: Mapping[str, LidarModel]) -> dict[str, LidarModel]:
        """Its LiDARs, mounted as others of the same names: those of the same vehicle.

        What is found of their places differs a bit from drive to drive. Pieces of walls join only
        at the mountings that their own drive has.
        """
        if self.walls is not None:
            return dict(self.scenario.lidars)
        return {
            name: model.model_copy(update={"mounting": others[name].mounting})
            for name, model in self.scenario.lidars.items()
        }

    def driving(self, other: Scenario) -> tuple[Scenario, Route]:
        """The drive and the world of another scenario with this vehicle."""
        own = self.scenario
        gnss = own.gnss.model_copy(update={"outages": ()})
        scenario = other.model_copy(
            update={
                "lidars": own.lidars,
                "reference": own.reference,
                "imu": own.imu,
                "gnss": gnss,
                "velocity": own.velocity,
                "poses": own.poses,
                "suspension": own.suspension,
                "initial_guess": own.initial_guess,
            }
        )
        return scenario, make_drive(other.drive, make_terrain(other.world.ground))


def recorded_drive(recording: Recording, config: Config, progress: Progress) -> RecordedDrive:
    """The vehicle of a recording, and its drive.

    Raises:
        CalivError: they cannot be told; the message says what to do.
    """
    if not config.names_motion():
        raise ConfigError(
            "topics: the config names nothing that measures the vehicle's motion, and what a next "
            f"drive would determine depends on it. {INSTEAD}"
        )
    seen = look(recording, config, progress)
    if seen.trajectory is None:
        said = [*seen.problems, *(found.sentence for found in seen.findings)]
        raise TrajectoryError(f"{recording.name}: {said[0] if said else 'no trajectory'}")
    config = seen.config or config
    begin_ns, end_ns = _span(recording, seen.trajectory)
    height_m, said_height = _height(recording, seen.trajectory, config, progress)
    motion = recorded_motion(seen.trajectory, config, begin_ns, height_m)
    route = RecordedRoute(seen.trajectory, begin_ns, end_ns, height_m)
    solved = solved_walls(recording, seen.trajectory, config, begin_ns, height_m, progress)
    walls_seen = _walls_seen(config, solved)
    objects, said_targets = _targets(seen, seen.trajectory, config, route, walls_seen)
    mountings = {name: lidar.guess() for name, lidar in config.lidars.items()}
    mountings |= {} if solved is None else dict(solved.T_vehicle_lidar)
    lidars = _lidars(recording, seen, config, route, mountings, progress)
    without = objects and walls_seen is False
    said_walls = (walls_sentence(),) if without else ()
    scenario = _scenario(recording, config, motion, route, lidars, objects)
    elsewhere = objects or {"chair": ChairModel(xy_m=(0.0, 0.0))}
    vehicle = scenario.model_copy(
        update={"world": WorldModel(objects=elsewhere, targets=tuple(elsewhere))}
    )
    return RecordedDrive(
        scenario,
        route,
        _assumptions(config),
        vehicle,
        bool(objects),
        (*seen.notes, *motion.notes, *said_height, *said_targets, *said_walls),
        None if solved is None else solved.walls,
    )


def _assumptions(config: Config) -> Assumptions:
    ground = config.ground
    heave_m = config.noise.heave_m
    return Assumptions(
        ground="none" if not ground.use else "plane" if ground.vehicle_height is None else "height",
        ground_height_sigma_m=ground.sigma,
        heave_sigma_m=HEAVE_SIGMA_M if heave_m is None else heave_m,
        time_offset=config.solve.time_offset,
        extraction=config.extraction,
        ranges=range_errors(config.noise),
        guesses={name: configured_guess(config, name) for name in config.lidars},
        structure=config.structure.use,
    )


def _span(recording: Recording, trajectory: VehicleTrajectory) -> tuple[int, int]:
    """First and last stamp of a cloud at which there is a pose."""
    stamps = np.array([t for n in recording.lidars for t in recording.scan_stamps_ns(n)], np.int64)
    begin, end = trajectory.span_ns
    within = stamps[(stamps >= begin) & (stamps <= end)]
    if len(within) < 2:
        raise RecordingError(
            f"{recording.name}: {len(within)} clouds are within the time of the motion data. "
            "Check their clocks with 'caliv-graph inspect'"
        )
    return int(within.min()), int(within.max())


def _height(
    recording: Recording, trajectory: VehicleTrajectory, config: Config, progress: Progress
) -> tuple[float, tuple[str, ...]]:
    """Height of the vehicle frame above ground, and what to say of it."""
    if config.ground.vehicle_height is not None:
        return config.ground.vehicle_height, ()
    grounds = lidar_grounds(recording, trajectory, config, progress)
    if not grounds:
        return 0.0, (unknown_height_sentence(),)
    heights = [g.height_m - float(config.lidars[g.lidar].guess().z()) for g in grounds]
    height_m = round(float(np.median(heights)), 3)
    return height_m, (height_sentence(height_m),)


def _walls_seen(config: Config, solved: SolvedWalls | None) -> bool | None:
    """Whether a drive has walls; None: they are not to be used."""
    return solved is not None if uses_walls(config) else None


def _targets(
    seen: Look,
    trajectory: VehicleTrajectory,
    config: Config,
    route: RecordedRoute,
    walls: bool | None,
) -> tuple[dict[str, ObjectModel], tuple[str, ...]]:
    """The objects that stand for the targets, by name, and what to say of them."""
    if not seen.observations:
        return {}, (no_target_sentence(seen.problems[-1] if seen.problems else "", walls),)
    mounts = {name: lidar.guess() for name, lidar in config.lidars.items()}
    objects: dict[str, ObjectModel] = {}
    said = []
    for number, found in enumerate(seen.observations, start=1):
        name = "target" if len(seen.observations) == 1 else f"target {number}"
        shown = silhouettes(found, trajectory, mounts)
        model = nearest_object(shown, found.centre_map, config.extraction.ground_distance)
        objects[name] = model
        widths = np.quantile(shown.width_m, [0.1, 0.9])
        height_m = float(np.quantile(shown.height_m, 0.9)) + config.extraction.ground_distance
        said.append(
            target_sentence(name, model.shape, (float(widths[0]), float(widths[1])), height_m)
        )
    return objects, tuple(said)


def _lidars(
    recording: Recording,
    seen: Look,
    config: Config,
    route: RecordedRoute,
    mountings: Mapping[str, gtsam.Pose3],
    progress: Progress,
) -> dict[str, LidarModel]:
    """The LiDARs, read off some of their clouds, with their T_vehicle_lidar."""
    out = {}
    with progress.stage("looking at the beams", len(recording.lidars)) as advance:
        for name in recording.lidars:
            stamps = np.asarray(recording.scan_stamps_ns(name), np.int64)
            stamps = stamps[(stamps >= route.begin_ns) & (stamps <= route.end_ns)]
            if len(stamps) < 2:
                raise RecordingError(
                    f"{recording.name}: LiDAR '{name}' has {len(stamps)} clouds within the time "
                    "of the motion data: remove it from lidars, or correct its topic"
                )
            chosen = _chosen(stamps, seen, name)
            clouds = [scan.points_lidar for scan in recording.scans(name, chosen)]
            out[name] = lidar_model(
                SeenBeams.of(clouds, f"{recording.name}: LiDAR '{name}'"),
                config.lidars[name],
                lifted(mountings[name], route.height_m),
                config.noise.lidar_range_m,
                stamps - route.begin_ns,
            )
            advance()
    return out


def _chosen(stamps_ns: IntArray, seen: Look, lidar: str) -> frozenset[int]:
    """Stamps of the clouds to read: spread over the drive, and over the views of targets."""
    towards = [c.stamp_ns for o in seen.observations or () for c in o.clouds if c.lidar == lidar]
    views = np.unique(np.asarray(towards, np.int64))
    out: set[int] = set()
    for some in (stamps_ns, views):
        if len(some):
            at = np.linspace(0, len(some) - 1, SCANS // 2).astype(np.int64)
            out |= set(some[at].tolist())
    return frozenset(out)


def _scenario(
    recording: Recording,
    config: Config,
    motion: RecordedMotion,
    route: RecordedRoute,
    lidars: Mapping[str, LidarModel],
    objects: Mapping[str, ObjectModel],
) -> Scenario:
    name = re.sub(r"[^\w. -]", "_", PurePath(recording.name).stem) or "drive"
    guesses = [configured_guess(config, n) for n in lidars]
    # Of a trusted one the scenario cannot say that it is.
    sigmas = np.array([g.sigmas for g in guesses if not g.fixed] or [DEFAULT_GUESS_SIGMAS])
    rotation_rad, translation_m = np.median(sigmas[:, :3]), np.median(sigmas[:, 3:])
    return Scenario(
        name=f"{name} as recorded",
        drive=_like(route),
        lidars=dict(lidars),
        reference=config.reference,
        world=WorldModel(
            ground=GroundModel(height_m=_ground_height(route, objects)),
            objects=dict(objects),
            targets=tuple(objects),
        ),
        imu=motion.imu,
        gnss=motion.gnss,
        velocity=motion.velocity,
        poses=motion.poses,
        gravity_m_s2=motion.gravity_m_s2,
        suspension=SuspensionModel(height_sigma_m=config.ground.sigma),
        initial_guess=InitialGuessModel(
            translation_m=round(float(translation_m) / UNIFORM_TO_SIGMA, 4),
            rotation_deg=round(math.degrees(float(rotation_rad)) / UNIFORM_TO_SIGMA, 4),
        ),
    )


def _like(route: RecordedRoute) -> ArcDrive:
    """An arc with the speed and the tightest turn of a drive, for `suggest` to start from."""
    speed, curvature = route.habits()
    radius = DEFAULT_RADIUS_M if curvature < 1.0 / RADII_M[1] else max(1.0 / curvature, RADII_M[0])
    return ArcDrive(
        duration_s=max(round(route.duration_s, 1), LEAST_SUGGESTED_S),
        speed_m_s=round(speed, 1) or DEFAULT_SPEED_M_S,
        radius_m=round(radius, 1),
    )


def _ground_height(route: RecordedRoute, objects: Mapping[str, ObjectModel]) -> float:
    """Of the place on the path that is nearest to a target: the ground may slope."""
    step_ns = max((route.end_ns - route.begin_ns) // 200, 1)
    stamps = np.arange(0, route.end_ns - route.begin_ns + 1, step_ns, dtype=np.int64)
    places = route.states(stamps).position_map
    if not objects:
        return round(float(np.median(places[:, 2])), 3)
    targets = np.array([model.xy_m for model in objects.values()])
    away = np.linalg.norm(places[:, None, :2] - targets[None], axis=2)
    return round(float(places[away.min(axis=1).argmin(), 2]), 3)


def next_drive(
    drives: Sequence[RecordedDrive], planned: Sequence[Scenario], assumptions: Assumptions
) -> Planned:
    """Predicts recorded drives of one vehicle, together with planned ones if there are any.

    Args:
        drives: of the vehicle, at least one; the first one's sensors are the vehicle's.
        planned: drives and worlds; the vehicle in them is replaced.
        assumptions: how all are calibrated.

    Raises:
        CalivError: as for `planning.predict`.
    """
    first = drives[0]
    lidars = first.scenario.lidars
    seeing = [d for d in drives if d.tells]
    recorded = [
        SeenDrive.of(
            d.scenario.model_copy(update={"lidars": d.mounted_as(lidars)}),
            d.route,
            assumptions,
            d.walls,
        )
        for d in seeing
    ]
    to_come = [SeenDrive.of(*first.driving(scenario), assumptions) for scenario in planned]
    every = [*recorded, *to_come]
    return Planned(
        predict_seen(every, assumptions) if every else None,
        (seeing or drives)[0].vehicle,
        assumptions,
        recorded,
        lidars,
        tuple(dict.fromkeys(note for d in drives for note in d.notes)),
    )
