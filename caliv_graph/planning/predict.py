"""Predicts the covariance of the extrinsics from a planned drive. README.md has the model.

No measurement is drawn. The graph that `calibrate` would solve is linearised along the planned
drive, and everything except the extrinsics is eliminated from its information. Poses, clouds and
ground planes form a chain in time whose states share a few coordinates (extrinsics, targets, ground
plane), so this takes 0.1 s; walls, and ground in cells, take one to three.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from caliv_graph.calibration.graph import OFFSET_SIGMA_S
from caliv_graph.calibration.solve import OFFSET_DETERMINED_S
from caliv_graph.config.guesses import prior_sigmas, trust_information
from caliv_graph.config.lidars import PoseSigmaConfig
from caliv_graph.config.model import ExtractionConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import CalivError, ConfigError, TargetError
from caliv_graph.planning.assumptions import Assumptions
from caliv_graph.planning.information import RIDGE, drive_information, eliminated
from caliv_graph.planning.recorded_walls import RecordedWalls
from caliv_graph.planning.sightings import Sighting, placements, sight, thinned
from caliv_graph.planning.structure import (
    PlannedStructure,
    SeenWalls,
    information_with_structure,
    plan_structure,
)
from caliv_graph.products import Array, Direction, Guess
from caliv_graph.scenario.drives import Route, make_drive
from caliv_graph.scenario.model import UNIFORM_TO_SIGMA, Scenario
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.targets.cloud.views import view_weights
from caliv_graph.uncertainty.predicted import (
    PredictedCovariance,
    predict_covariance,
)
from caliv_graph.wording.directions import named_prediction
from caliv_graph.wording.offsets import undetermined_offset_sentences

OPPOSITE_DEG = 120.0
"""LiDARs with a larger angle between their views of a target share little of its surface."""


@dataclass(frozen=True)
class Prediction:
    """Predicted result of one planned drive, or of several drives of one vehicle.

    Attributes:
        names: names of the drives.
        covariance: predicted sigmas, covariance and undetermined directions.
        sightings: clouds in which each LiDAR sees each target, per drive.
        walls: what each LiDAR sees of the walls, per drive; None: there are none.
        space_m: sides of the rectangle along the map's axes around path and targets, the largest of
            each over the drives.
        duration_s: duration of all drives together.
        warnings: warnings for the user, one line each.
    """

    names: tuple[str, ...]
    covariance: PredictedCovariance
    sightings: tuple[tuple[Sighting, ...], ...]
    walls: tuple[SeenWalls | None, ...]
    space_m: tuple[float, float]
    duration_s: float
    warnings: tuple[str, ...]

    @property
    def sigma_s2v(self) -> Mapping[str, Array]:
        """LiDAR -> (6,) 1 sigma of its extrinsic, vehicle axes, rotation then translation."""
        return self.covariance.sigma_s2v

    @property
    def sigma_s2s(self) -> Mapping[tuple[str, str], Array]:
        """(from, to) -> (6,) 1 sigma of their relative pose, likewise, at `from`'s origin."""
        return self.covariance.sigma_s2s

    @property
    def undetermined(self) -> tuple[Direction, ...]:
        """Directions that the drive does not determine."""
        return self.covariance.undetermined


def predict(
    scenario: Scenario,
    others: Sequence[Scenario] = (),
    assumptions: Assumptions | None = None,
) -> Prediction:
    """Predicts the covariance of a calibration, from the drive's geometry and the sensors' noise.

    Args:
        scenario: the drive.
        others: more drives of the same vehicle, solved together with it.
        assumptions: how it will be recorded and calibrated.

    Raises:
        ConfigError: the scenario has neither target nor walls, or the drives are not of the same
            vehicle.
        TargetError: no LiDAR sees a target or a wall.
        TrajectoryError: its sensors do not determine the vehicle's motion.
    """
    assumptions = assumptions or Assumptions()
    scenarios = (scenario, *others)
    for other in others:
        if other.lidars.keys() != scenario.lidars.keys() or any(
            other.lidars[n].mounting != scenario.lidars[n].mounting for n in scenario.lidars
        ):
            raise ConfigError(
                f"scenario '{other.name}': its lidars are not those of '{scenario.name}': several "
                "drives must be of one vehicle: rename them alike"
            )
    planned = [(s, make_drive(s.drive, make_terrain(s.world.ground))) for s in scenarios]
    return predict_drives(planned, assumptions)


@dataclass(frozen=True)
class SeenDrive:
    """One drive of a prediction, and what its LiDARs see.

    Attributes:
        scenario: vehicle, sensors and world.
        drive: the drive.
        assumptions: how it will be recorded and calibrated.
        sightings: clouds in which each LiDAR sees each target.
        structure: the structure that it passes, if any is used.
    """

    scenario: Scenario
    drive: Route
    assumptions: Assumptions
    sightings: tuple[Sighting, ...]
    structure: PlannedStructure | None
    _known: dict[tuple[str, ...], Array] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        drive: Route,
        assumptions: Assumptions,
        recorded: RecordedWalls | None = None,
    ) -> SeenDrive:
        """Finds out what the LiDARs see; `recorded` walls replace those of the scenario.

        Raises:
            ConfigError: the drive ends before the first sample of a sensor.
        """
        sightings = _sightings(scenario, drive, assumptions)
        structure = plan_structure(scenario, drive, sightings, assumptions, recorded)
        return cls(scenario, drive, assumptions, sightings, structure)

    def information(self, lidars: tuple[str, ...]) -> Array:
        """As `drive_information`, with structure if there is any; zero if the drive tells nothing.

        It is computed once: a suggestion solves a recorded drive together with many others.
        """
        if lidars not in self._known:
            self._known[lidars] = self._computed(lidars)
        return self._known[lidars]

    def _computed(self, lidars: tuple[str, ...]) -> Array:
        scenario, drive, of = self.scenario, self.drive, self.assumptions
        if self.structure is not None:
            H = information_with_structure(scenario, drive, self.sightings, self.structure, of)
            names = list(scenario.lidars)
            index = [names.index(name) for name in lidars]
            own = [6 * i + axis for i in index for axis in range(6)]
            own += [6 * len(names) + i for i in index if of.time_offset]
            # A LiDAR that is not planned sees ground, perhaps, and is unknown.
            rest = np.setdiff1d(np.arange(len(H)), own)
            H[rest, rest] += RIDGE
            order = np.concatenate([np.array(own, dtype=np.int64), rest])
            return eliminated(H[np.ix_(order, order)], len(own))
        if any(len(s.used) for s in self.sightings):
            return drive_information(scenario, drive, self.sightings, lidars, of)
        size = (7 if of.time_offset else 6) * len(lidars)
        return np.zeros((size, size))


def predict_drives(
    planned: Sequence[tuple[Scenario, Route]], assumptions: Assumptions
) -> Prediction:
    """Like `predict`, for drives that a scenario cannot describe.

    Args:
        planned: scenarios of one vehicle, each with the drive that replaces its own.
        assumptions: how they will be recorded and calibrated.

    Raises:
        ConfigError, TargetError, TrajectoryError: as for `predict`.
    """
    return predict_seen([SeenDrive.of(*pair, assumptions) for pair in planned], assumptions)


def predict_seen(drives: Sequence[SeenDrive], assumptions: Assumptions) -> Prediction:
    """Like `predict_drives`, for drives whose sightings are known.

    Raises:
        ConfigError, TargetError, TrajectoryError: as for `predict`.
    """
    planned = [(of.scenario, of.drive) for of in drives]
    seen, structures = [of.sightings for of in drives], [of.structure for of in drives]
    first = drives[0].scenario
    # Ground alone places no LiDAR.
    by_structure = frozenset(lidar for s in structures if s for _, lidar in s.walls.scans)
    lidars = tuple(
        name
        for name in first.lidars
        if name in by_structure or any(len(s.used) for of in seen for s in of if s.lidar == name)
    )
    if not lidars:
        raise _nobody(planned, seen, assumptions.extraction)
    information = np.sum([of.information(lidars) for of in drives], axis=0)
    guesses = _guesses(first, assumptions)
    size = 6 * len(lidars)
    information[:size, :size] += trust_information([guesses[name] for name in lidars])
    sigmas = np.concatenate([prior_sigmas(guesses[name]) for name in lidars])
    D, offsets_s = _without_offsets(information, lidars, np.diag(sigmas**-2.0))
    covariance = predict_covariance(
        D,
        lidars,
        first.reference if first.reference in lidars else lidars[0],
        {name: guesses[name].T_vehicle_lidar for name in lidars},
        guesses,
        {name: sum(len(s.used) for of in seen for s in of if s.lidar == name) for name in lidars},
        offsets_s,
        by_structure,
    )
    return Prediction(
        names=tuple(scenario.name for scenario, _ in planned),
        covariance=named_prediction(covariance),
        sightings=tuple(seen),
        walls=tuple(s.walls if s and s.walls.scans else None for s in structures),
        space_m=space(planned),
        duration_s=sum(drive.duration_s for _, drive in planned),
        warnings=(
            *_warnings(planned, seen, lidars, guesses, assumptions.time_offset),
            *undetermined_offset_sentences(offsets_s, OFFSET_DETERMINED_S),
        ),
    )


def _sightings(scenario: Scenario, drive: Route, assumptions: Assumptions) -> tuple[Sighting, ...]:
    """Clouds in which each LiDAR sees each placement, and which of them are used."""
    extraction = assumptions.extraction
    out = []
    for placement in placements(scenario):
        sightings = [
            sight(drive, scenario, name, placement, extraction) for name in scenario.lidars
        ]
        seeing = sum(len(s.stamps_ns) >= extraction.min_scans for s in sightings)
        for s in sightings:
            used = thinned(view_weights(s.centres_lidar), seeing, extraction)
            out.append(replace(s, used=used))
    return tuple(out)


def _nobody(
    planned: Sequence[tuple[Scenario, Route]],
    seen: Sequence[Sequence[Sighting]],
    extraction: ExtractionConfig,
) -> CalivError:
    names = ", ".join(f"'{scenario.name}'" for scenario, _ in planned)
    if not any(seen):
        return ConfigError(
            f"scenario {names}: there is nothing to plan with: world.targets names no target, and "
            "no LiDAR sees a wall. Add an object and its name there, or walls"
        )
    best = max((s for of in seen for s in of), key=lambda s: len(s.stamps_ns))
    return TargetError(
        f"scenario {names}: no LiDAR sees a target: '{best.lidar}' would have '{best.placement}' "
        f"in view in {len(best.stamps_ns)} of {best.scans} scans with {extraction.min_points} "
        f"points or more, and {extraction.min_scans} are needed. Move the target nearer to the "
        "path, or drive longer"
    )


def _warnings(
    planned: Sequence[tuple[Scenario, Route]],
    seen: Sequence[Sequence[Sighting]],
    lidars: Sequence[str],
    guesses: Mapping[str, Guess],
    time_offset: bool,
) -> Iterable[str]:
    for name in planned[0][0].lidars:
        if name not in lidars:
            then = "it keeps its initial guess"
            if guesses[name].found:
                then = "its extrinsics stay unknown, because it has no initial guess"
            yield f"lidar '{name}' never sees a target or a wall often enough: {then}"
    for scenario, _ in planned:
        for placement in placements(scenario):
            if placement.is_round:
                yield (
                    f"target '{placement.name}' is symmetric about its axis: its yaw is "
                    "unobservable. Take a chair, or anything without symmetry"
                )
    yield from _unshared(seen, lidars)
    if not time_offset:
        for scenario, _ in planned:
            for name, lidar in scenario.lidars.items():
                if lidar.time_offset_s:
                    yield (
                        f"the stamps of lidar '{name}' are off by {1e3 * lidar.time_offset_s:+.0f} "
                        "ms, which no sigma here includes: estimate its time offset "
                        "(--time-offset; solve.time_offset)"
                    )
    for scenario, _ in planned:
        if scenario.imu.enabled and scenario.imu.orientation.yaw_bias_deg:
            yield (
                f"the heading of the orientation source is off by "
                f"{scenario.imu.orientation.yaw_bias_deg:g} degrees. The yaw of every LiDAR gets "
                "the same error, which no sigma here includes"
            )


def _unshared(seen: Sequence[Sequence[Sighting]], lidars: Sequence[str]) -> Iterable[str]:
    """A warning per pair of LiDARs that see a target only from opposite sides."""
    for i, a in enumerate(lidars):
        for b in lidars[i + 1 :]:
            apart = []
            for sightings in seen:
                of = {(s.lidar, s.placement): s.towards_deg[s.used] for s in sightings}
                for placement in {s.placement for s in sightings}:
                    one, other = of[a, placement], of[b, placement]
                    if len(one) and len(other):
                        angle = np.abs((one[:, None] - other[None] + 180.0) % 360.0 - 180.0)
                        apart.append(float(angle.min()))
            if apart and min(apart) > OPPOSITE_DEG:
                yield (
                    f"lidars '{a}' and '{b}' see a target from sides at least {min(apart):.0f} "
                    "degrees apart: they share little of its surface, and the predicted sigma of "
                    "one against the other is too small. Pass the target on one side only"
                )


def space(planned: Sequence[tuple[Scenario, Route]]) -> tuple[float, float]:
    """Sides of the rectangles around path and targets, the largest of each, metres."""
    sides = []
    for scenario, drive in planned:
        stamps = np.linspace(0, drive.duration_s * 1e9, 200).astype(np.int64)
        places = [
            drive.states(stamps).position_map[:, :2],
            *(p.centre_map[None, :2] for p in placements(scenario)),
        ]
        sides.append(np.ptp(np.concatenate(places), axis=0))
    x, y = np.max(sides, axis=0).tolist()
    return (x, y)


def _guesses(scenario: Scenario, assumptions: Assumptions) -> dict[str, Guess]:
    """The initial guess of every LiDAR; its extrinsic is that of the scenario."""
    usual = Guess(gtsam.Pose3(), _guess_sigmas(scenario))
    return {
        name: replace(assumptions.guesses.get(name, usual), T_vehicle_lidar=model.mounting.pose())
        for name, model in scenario.lidars.items()
    }


def _guess_sigmas(scenario: Scenario) -> Array:
    """(6,) of an initial guess, vehicle axes, as in the config that `simulate` writes."""
    guess, usual = scenario.initial_guess, PoseSigmaConfig(xyz=0.058, rpy_deg=1.73)
    turn = math.radians(guess.rotation_deg) * UNIFORM_TO_SIGMA
    shift = guess.translation_m * UNIFORM_TO_SIGMA
    return np.array(
        [*([turn] * 3 if turn else usual.rpy_rad()), *([shift] * 3 if shift else usual.xyz_m())]
    )


def _without_offsets(
    information: Array, lidars: Sequence[str], prior: Array
) -> tuple[Array, dict[str, float]]:
    """Information on the extrinsics alone, and the sigma of each time offset, if there are any."""
    size = 6 * len(lidars)
    if len(information) == size:
        return information, {}
    both = information.copy()
    offsets = np.arange(size, len(both))
    both[offsets, offsets] += OFFSET_SIGMA_S**-2.0
    known = both.copy()
    known[:size, :size] += prior
    scale = 1.0 / np.sqrt(np.diagonal(known))
    cov = np.linalg.inv(known * np.outer(scale, scale)) * np.outer(scale, scale)
    sigma = np.sqrt(np.diagonal(cov))[offsets]
    return eliminated(both, size), dict(zip(lidars, sigma.tolist(), strict=True))


def sigma_of(prediction: Prediction, key: str) -> dict[str, float]:
    """Predicted sigmas to which a limit such as `s2v_yaw_deg` or `s2s_x_m` applies.

    Args:
        prediction: of a drive.
        key: as in `limits` of a config.

    Returns:
        Extrinsic ("'front'", "'front' to 'rear'") -> sigma in the unit of the key.
    """
    kind, axis, unit = key.split("_", 2)
    index = AXES.index(axis)
    factor = math.degrees(1.0) if unit == "deg" else 1.0
    if kind == "s2v":
        return {f"'{n}'": float(s[index]) * factor for n, s in prediction.sigma_s2v.items()}
    return {
        f"'{a}' to '{b}'": float(s[index]) * factor for (a, b), s in prediction.sigma_s2s.items()
    }
