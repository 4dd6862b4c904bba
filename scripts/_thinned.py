"""A drive simulated many times with new noise, casting only the relevant beams.

The beams that hit the target or its surroundings depend on the vehicle's path and hardly on the
noise. They are selected once per scenario with whole clouds, and kept in a file. Every seed then
casts these beams with its own height, heave and noise. The returns equal those of whole clouds, but
their number is a hundred times smaller.
"""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from caliv_graph.common.files import atomic_write
from caliv_graph.common.progress import Progress, SilentProgress
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array, IntArray, LidarScan
from caliv_graph.scenario.drives import VehicleStates
from caliv_graph.scenario.model import CropModel, Scenario, SuspensionModel, dump_scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world import GROUND
from caliv_graph.simulation.lidar import LidarReturns, SimulatedLidar, beam_directions
from caliv_graph.simulation.noise import Stream, random_stream
from caliv_graph.simulation.recording import SimulatedRecording, SimulatedScan

SELECTION_VERSION = 1
"""Version of the selection rule, part of the digest of a selection."""

NEIGHBOURS = 2
"""Beams added to each side of those that hit. 2 channels of the paper's LiDAR are 35 mm at 6 m,
seven standard deviations of height and heave."""

REACH = 3.0
"""Widening of a region for errors of the initial guess: two to three times the largest error at the
region's range."""

GROUND_NEAR_TARGET = 400
"""Approximate number of beams at the ground of a target's region."""

GROUND_RADIUS_M = 15.5
GROUND_PER_M2 = 3
"""Beams per square metre of the ground around the vehicle. Whole clouds have more, of which
`targets.ground.planes` uses ten. With three, the error of a plane by noise (0.02 mrad and 0.2 mm)
is still far below the floors of its sigmas (0.5 mrad and 2 mm)."""

SKY_STRIDE = 16
EDGE_STRIDE = 4
"""Every n-th channel and column of all other beams, and of those at the left and right edge of the
field of view, is kept. They show the extent of the field of view."""

PATCH_RAD = math.radians(11.0)
"""Size of a patch of the field of view that keeps all beams and so shows their density."""

OTHERS = 10
"""Every n-th cloud without anything relevant in view is kept."""

NEIGHBOUR_NS = 110_000_000
"""Clouds of other LiDARs that are nearer in time to a relevant one are kept, for the ground."""


@dataclass(frozen=True)
class GroundWaves:
    """Waves of the ground, drawn anew for every drive; they stay where they are during it.

    Asphalt is no plane, and the weights of ground planes assume that (`targets.ground.planes`).
    Without waves, NEES would be too small.

    Attributes:
        sigma_m: 1 sigma of its height, `GroundModel.waves_sigma_m`; that of a good road.
    """

    sigma_m: float = 2.2e-3

    def on(self, scenario: Scenario, seed: int) -> Scenario:
        """A scenario whose ground has waves."""
        drawn = int(random_stream(seed, Stream.GROUND_WAVES).integers(2**31))
        ground = scenario.world.ground.model_copy(
            update={"waves_sigma_m": self.sigma_m, "waves_seed": drawn}
        )
        world = scenario.world.model_copy(update={"ground": ground})
        return scenario.model_copy(update={"world": world})


@dataclass(frozen=True)
class BeamSelection:
    """Clouds of a scenario that are simulated, and the beams of each.

    Attributes:
        digest: digest of the scenario and the rule.
        fixed: per LiDAR, the beams of every cloud, ascending.
        idle: per LiDAR, the beams of every `OTHERS`th cloud without anything relevant in view.
        near: per LiDAR, by index of the cloud: beams at targets and their surroundings.
        frames: per LiDAR, the indices of the clouds that are simulated, ascending.
    """

    digest: str
    fixed: Mapping[str, IntArray]
    idle: Mapping[str, IntArray]
    near: Mapping[str, Mapping[int, IntArray]]
    frames: Mapping[str, IntArray]

    def beams(self, lidar: str, frame: int) -> IntArray:
        """(n,) numbers of the beams of one cloud, ascending."""
        near, fixed = self.near[lidar].get(frame), self.fixed[lidar]
        if near is None:
            return self.idle[lidar] if frame % OTHERS == 0 else fixed
        # Faster than a union of sorted arrays.
        chosen = np.zeros(max(int(fixed[-1]), int(near[-1])) + 1, np.bool_)
        chosen[fixed] = True
        chosen[near] = True
        return np.flatnonzero(chosen)


def scenario_digest(scenario: Scenario) -> str:
    """Digest of everything that a selection depends on; noise is not part of it."""
    silent = _without_noise(scenario)
    text = f"{SELECTION_VERSION}\n{dump_scenario(silent)}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without_noise(scenario: Scenario) -> Scenario:
    """The scenario with whole clouds and without any draw that moves a beam."""
    lidars = {
        name: model.model_copy(update={"range_sigma_m": 0.0, "edges": None})
        for name, model in scenario.lidars.items()
    }
    fresh = Scenario(name=scenario.name, drive=scenario.drive, lidars=lidars, world=scenario.world)
    return fresh.model_copy(
        update={
            "crop": scenario.crop,
            "initial_guess": scenario.initial_guess,
            "vehicle_body": scenario.vehicle_body,
            "suspension": SuspensionModel(height_sigma_m=0.0, heave_sigma_m=0.0),
        }
    )


class _Selector(SimulatedRecording):
    """Finds the relevant beams, at the true poses without noise."""

    def __init__(self, scenario: Scenario, threads: int) -> None:
        super().__init__(_without_noise(scenario), 0, threads)
        world = self.scenario.world
        self._regions = [
            (low - world.region_margin_m, high + world.region_margin_m)
            for low, high in map(self.world.bounds, self.world.targets)
        ]
        self._ground_id = self.world.names.index(GROUND)

    def near(self, lidar: str, progress: Progress) -> dict[int, IntArray]:
        """By index of the cloud, the beams at targets and in their regions."""
        model = self.scenario.lidars[lidar]
        reach_m = self._reach_m(model.max_range_m)
        half_m = max(0.5 * float(np.linalg.norm(high - low)) for low, high in self._regions)
        # The largest sphere around a widened region.
        crop = CropModel(margin_m=half_m + reach_m, elsewhere_stride=0)
        simulated = SimulatedLidar(
            model, self.world, self._caster, crop, random_stream(0, Stream.LIDAR)
        )
        out = {}
        stamps = self._frame_stamps(lidar).tolist()
        with progress.stage(f"choosing the beams of '{lidar}'", len(stamps)) as advance:
            for frame, stamp_ns in enumerate(stamps):
                taken_ns, states = self._moments(simulated, model, stamp_ns)
                seconds = taken_ns / NANOSECONDS_PER_SECOND
                returns = simulated.sweep(states.R_map_vehicle, states.position_map, seconds)
                beams = self._chosen(simulated, returns, states)
                if beams is not None:
                    out[frame] = beams
                advance()
        return out

    def _reach_m(self, range_m: float) -> float:
        guess = self.scenario.initial_guess
        # Beyond 30 m no LiDAR has enough points on a target.
        return REACH * (guess.translation_m + math.radians(guess.rotation_deg) * min(range_m, 30.0))

    def _chosen(
        self, simulated: SimulatedLidar, returns: LidarReturns, states: VehicleStates
    ) -> IntArray | None:
        column = np.zeros(1, np.int64)
        if len(states.R_map_vehicle) > 1:
            column = simulated.columns_of(returns)
        T_vehicle_lidar = simulated.T_vehicle_lidar
        vehicle = returns.points_lidar @ T_vehicle_lidar.rotation().matrix().T
        vehicle += T_vehicle_lidar.translation()
        points_map = np.einsum("nij,nj->ni", states.R_map_vehicle[column], vehicle)
        points_map += states.position_map[column]
        range_m = np.linalg.norm(returns.points_lidar, axis=1)
        guess = self.scenario.initial_guess
        reach_m = REACH * (guess.translation_m + math.radians(guess.rotation_deg) * range_m)
        inside = np.zeros(len(range_m), np.bool_)
        for low, high in self._regions:
            outside = np.maximum(np.maximum(low - points_map, points_map - high), 0.0)
            inside |= np.linalg.norm(outside, axis=1) <= reach_m
        ground = returns.objects == self._ground_id
        things = returns.beams[inside & ~ground & (returns.objects != self._vehicle_id)]
        if not len(things):
            return None
        sparse = returns.beams[inside & ground]
        stride = max(math.isqrt(len(sparse) // GROUND_NEAR_TARGET), 1)
        channel, at = np.divmod(sparse, simulated.columns)
        sparse = sparse[(channel % stride == 0) & (at % stride == 0)]
        return np.union1d(_with_neighbours(things, simulated.columns, simulated.channels), sparse)

    @property
    def _vehicle_id(self) -> int:
        return len(self.world.names) - 1 if self.world.vehicle is not None else -2


def _with_neighbours(beams: IntArray, columns: int, channels: int) -> IntArray:
    """Beams and those next to them, ascending."""
    chosen = np.zeros((channels, columns), np.bool_)
    chosen.reshape(-1)[beams] = True
    square = np.ones((2 * NEIGHBOURS + 1, 2 * NEIGHBOURS + 1), np.bool_)
    return np.flatnonzero(binary_dilation(chosen, square))


def fixed_beams(model: LidarModel) -> tuple[IntArray, IntArray]:
    """Beams of every cloud of a LiDAR, and those of a cloud with nothing relevant in view.

    Args:
        model: the LiDAR; its vehicle frame is on level ground.
    """
    directions = beam_directions(model)
    channels, columns = directions.shape[:2]
    T_vehicle_lidar = model.mounting.pose()
    beams_vehicle = directions.reshape(-1, 3) @ T_vehicle_lidar.rotation().matrix().T
    height_m = float(T_vehicle_lidar.translation()[2])
    chosen = np.zeros((channels, columns), np.bool_)
    chosen[::SKY_STRIDE, ::SKY_STRIDE] = True
    chosen[::EDGE_STRIDE, [0, -1]] = True
    if height_m > 0.0:
        # Horizontal offset of a beam per metre of descent to level ground.
        falls = np.minimum(beams_vehicle[:, 2], -1e-9)
        xy = beams_vehicle[:, :2] / -falls[:, None] * height_m
        near = np.flatnonzero((xy**2).sum(axis=1) < GROUND_RADIUS_M**2)
        chosen.reshape(-1)[near[_spread(xy[near])]] = True
    idle = chosen.copy()
    half = [max(round(0.5 * PATCH_RAD / step), 1) for step in _steps(model, channels, columns)]
    middle = (channels // 2, columns // 2)
    idle[
        max(middle[0] - half[0], 0) : middle[0] + half[0] + 1,
        max(middle[1] - half[1], 0) : middle[1] + half[1] + 1,
    ] = True
    return np.flatnonzero(chosen), np.flatnonzero(idle)


def _steps(model: LidarModel, channels: int, columns: int) -> tuple[float, float]:
    """Mean angle between channels and between columns, radians."""
    elevations = model.elevations_deg or model.vertical_fov_deg
    low, high = model.horizontal_fov_deg
    return (
        math.radians((elevations[-1] - elevations[0]) / (channels - 1)),
        math.radians((high - low) / columns),
    )


def _spread(xy: Array) -> IntArray:
    """Indices of some of the places (n, 2), with the same number in each square metre."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(xy))
    cells = np.floor(xy[order]).astype(np.int64)
    number = (cells[:, 0] + 4096) * 8192 + cells[:, 1] + 4096
    by_cell = np.argsort(number, kind="stable")
    first = np.flatnonzero(np.diff(number[by_cell], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    return np.asarray(np.sort(order[by_cell[rank < GROUND_PER_M2]]))


def select_beams(
    scenario: Scenario, threads: int = 1, progress: Progress | None = None
) -> BeamSelection:
    """Selects the relevant beams with whole clouds.

    Args:
        scenario: the drive; its config must name the target region.
        threads: threads that cast rays; the result does not depend on it.
        progress: advanced at every cloud.

    Raises:
        ConfigError: it has no target, or its config does not name the region.
        CalivError: open3d cannot be loaded.
    """
    if not scenario.world.targets or scenario.config_target == "search":
        raise ConfigError(
            f"scenario '{scenario.name}': has no target whose region its config names, so that no "
            "beam of it can be left out: give world.targets, and config_target: region"
        )
    selector = _Selector(scenario, threads)
    shown = progress or SilentProgress()
    near = {name: selector.near(name, shown) for name in scenario.lidars}
    stamps = {name: np.asarray(selector.scan_stamps_ns(name), np.int64) for name in scenario.lidars}
    matter = np.unique(np.concatenate([stamps[name][list(near[name])] for name in near]))
    fixed, idle = {}, {}
    for name, model in scenario.lidars.items():
        fixed[name], idle[name] = fixed_beams(model)
    return BeamSelection(
        scenario_digest(scenario),
        fixed,
        idle,
        near,
        {name: _frames(stamps[name], matter) for name in scenario.lidars},
    )


def _frames(stamps_ns: IntArray, matter_ns: IntArray) -> IntArray:
    """Indices of the clouds to simulate: those near a relevant one, and some of the others."""
    chosen = np.zeros(len(stamps_ns), np.bool_)
    chosen[::OTHERS] = True
    chosen[-1:] = True
    if len(matter_ns):
        after = np.searchsorted(matter_ns, stamps_ns)
        for index in (after - 1, after):
            nearest = matter_ns[np.clip(index, 0, len(matter_ns) - 1)]
            chosen |= np.abs(nearest - stamps_ns) <= NEIGHBOUR_NS
    return np.flatnonzero(chosen)


def cached_selection(
    scenario: Scenario, folder: Path, threads: int = 1, progress: Progress | None = None
) -> BeamSelection:
    """`select_beams`, or its last result from a file in a folder.

    Args:
        scenario: the drive.
        folder: folder of the files; it is created.
        threads: threads that cast rays.
        progress: advanced at every cloud.
    """
    path = folder / f"beams-{scenario.name}-{scenario_digest(scenario)}.npz"
    if path.exists():
        return _read(path, tuple(scenario.lidars))
    selection = select_beams(scenario, threads, progress)
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **_arrays(selection))
    atomic_write(path, content.getvalue(), force=True)  # others may write the same
    return selection


def _arrays(selection: BeamSelection) -> dict[str, npt.NDArray[np.generic]]:
    out: dict[str, npt.NDArray[np.generic]] = {"digest": np.array(selection.digest)}
    for i, name in enumerate(selection.fixed):
        near = selection.near[name]
        out |= {
            f"fixed_{i}": selection.fixed[name],
            f"idle_{i}": selection.idle[name],
            f"frames_{i}": selection.frames[name],
            f"near_frames_{i}": np.array(list(near), np.int64),
            f"near_counts_{i}": np.array([len(beams) for beams in near.values()], np.int64),
            f"near_beams_{i}": np.concatenate([*near.values(), np.zeros(0, np.int64)]).astype(
                np.int32
            ),
        }
    return out


def _read(path: Path, lidars: Sequence[str]) -> BeamSelection:
    with np.load(path) as stored:

        def of(what: str) -> dict[str, IntArray]:
            return {n: stored[f"{what}_{i}"].astype(np.int64) for i, n in enumerate(lidars)}

        frames, counts, beams = of("near_frames"), of("near_counts"), of("near_beams")
        near = {
            name: dict(
                zip(
                    frames[name].tolist(),
                    np.split(beams[name], np.cumsum(counts[name])[:-1]),
                    strict=True,
                )
            )
            if len(frames[name])
            else {}
            for name in lidars
        }
        return BeamSelection(str(stored["digest"]), of("fixed"), of("idle"), near, of("frames"))


class ThinnedRecording(SimulatedRecording):
    """A simulated drive with the relevant beams only, for a config that names the target's region.

    Motion data and initial guesses equal those of a `SimulatedRecording` of the same seed. The
    noise of the clouds has the same distribution but other draws: every cloud has its own stream,
    so nothing is drawn for beams and clouds that are left out. Clouds are cached.
    """

    def __init__(
        self,
        scenario: Scenario,
        selection: BeamSelection,
        seed: int,
        threads: int = 1,
        waves: GroundWaves | None = None,
    ) -> None:
        """Draws the errors that hold for the whole drive.

        Args:
            scenario: the drive.
            selection: its beams.
            seed: seed of all draws.
            threads: threads that cast rays; the result does not depend on it.
            waves: of the ground, beside what the scenario has; None: none. They hardly move a
                beam, so the selection is of the scenario without.

        Raises:
            ConfigError: the seed is negative, or the selection is for another scenario.
        """
        if selection.digest != scenario_digest(scenario):
            raise ConfigError(
                f"scenario '{scenario.name}': the selection of beams is another scenario's "
                f"({selection.digest}): select them anew"
            )
        super().__init__(scenario if waves is None else waves.on(scenario, seed), seed, threads)
        self.selection = selection
        self._cast: dict[tuple[str, int], SimulatedScan] = {}

    @cached_property
    def _simulated(self) -> dict[str, SimulatedLidar]:
        return {
            name: SimulatedLidar(
                model,
                self.world,
                self._caster,
                None,
                random_stream(self.seed, Stream.LIDAR, index),
                self.truth.range_bias_m[name],
                self.channel_errors.get(name),
            )
            for index, (name, model) in enumerate(self.scenario.lidars.items())
        }

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds that are simulated."""
        stamps = np.asarray(super().scan_stamps_ns(lidar), np.int64)
        return [int(stamp) for stamp in stamps[self.selection.frames[lidar]]]

    def scans_with_truth(
        self, lidar: str, wanted: Container[int] | None = None
    ) -> Iterator[SimulatedScan]:
        """Like `scans`, with the object of each point."""
        index = list(self.scenario.lidars).index(lidar)
        stamps = self._frame_stamps(lidar).tolist()
        for frame in self.selection.frames[lidar].tolist():
            stamp_ns = stamps[frame]
            if wanted is not None and stamp_ns + self.truth.start_ns not in wanted:
                continue
            if (lidar, frame) not in self._cast:
                self._cast[lidar, frame] = self._thin(lidar, index, frame, stamp_ns)
            yield self._cast[lidar, frame]

    def _thin(self, lidar: str, index: int, frame: int, stamp_ns: int) -> SimulatedScan:
        model, simulated = self.scenario.lidars[lidar], self._simulated[lidar]
        taken_ns, states = self._moments(simulated, model, stamp_ns)
        returns = simulated.sweep_of(
            self.selection.beams(lidar, frame),
            states.R_map_vehicle,
            states.position_map,
            taken_ns / NANOSECONDS_PER_SECOND,
            random_stream(self.seed, Stream.THINNED_LIDAR, index, frame),
        )
        scan = LidarScan(
            lidar=lidar,
            stamp_ns=stamp_ns + self.truth.start_ns,
            points_lidar=returns.points_lidar,
            source=f"{lidar} at {stamp_ns / NANOSECONDS_PER_SECOND:.3f} s",
            point_times_s=self._point_times_s(simulated, model, returns),
        )
        return SimulatedScan(scan, frame, returns.objects)
