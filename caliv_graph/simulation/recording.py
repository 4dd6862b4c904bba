"""A simulated drive as a recording in memory, equal to a reader of its bag."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray, LidarScan, MotionData
from caliv_graph.scenario.drives import Drive, VehicleStates, cloud_stamps, make_drive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.scenario.world import World, make_world
from caliv_graph.simulation.lidar import Drawn, LidarReturns, SimulatedLidar
from caliv_graph.simulation.motion import (
    SimulatedGnss,
    SimulatedImu,
    simulate_gnss,
    simulate_imu,
    simulate_velocity,
    start_ns,
)
from caliv_graph.simulation.noise import (
    Stream,
    drawn_channel_errors,
    drawn_range_bias_m,
    height_and_heave,
    perturbed_extrinsic,
    random_stream,
)
from caliv_graph.simulation.rays import RayCaster

HEAVE_PERIOD_NS = NANOSECONDS_PER_SECOND // 10
"""Period with which the heave of the vehicle is redrawn. Clouds of one period share it."""


@dataclass(frozen=True)
class SimulatedTruth:
    """The truth of a simulated drive.

    Stamps are those of the recording. The map is ENU with its origin at the datum. `trajectory` may
    choose another origin (the first fix), so align the origins before comparing poses.

    Attributes:
        T_vehicle_lidar: true extrinsic per LiDAR.
        time_offset_s: per LiDAR, stamp minus true acquisition time.
        datum: latitude and longitude in degrees and altitude in metres of the map's origin.
        start_ns: stamp of the start.
        end_ns: stamp of the end.
        drive: the drive; its stamps count from its start.
        level_z_map: height of the vehicle frame in the map where the ground is level, in metres:
            the ground's height plus this drive's height error.
        heave_m: (n,) lift of the vehicle while clouds are taken, metres, one value per
            `HEAVE_PERIOD_NS` of their stamps. The poses of this class exclude it.
        range_bias_m: constant error of the ranges per LiDAR, metres.
    """

    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    time_offset_s: Mapping[str, float]
    datum: tuple[float, float, float]
    start_ns: int
    end_ns: int
    drive: Drive
    level_z_map: float
    heave_m: Array
    range_bias_m: Mapping[str, float]

    def states(self, stamps_ns: IntArray) -> VehicleStates:
        """Pose, velocity, acceleration and angular velocity at any stamps of the recording."""
        return self.drive.states(np.asarray(stamps_ns) - self.start_ns, self.level_z_map)

    def T_map_vehicle(self, stamps_ns: IntArray) -> tuple[gtsam.Pose3, ...]:
        """The vehicle's poses at any stamps of the recording."""
        return self.drive.poses(np.asarray(stamps_ns) - self.start_ns, self.level_z_map)


@dataclass(frozen=True)
class SimulatedScan:
    """One cloud and its truth.

    Attributes:
        scan: the cloud.
        frame: index of the cloud of this LiDAR, from 0.
        objects: (n,) index into `World.names` of the object of each point, -1 for a return from
            between two surfaces.
    """

    scan: LidarScan
    frame: int
    objects: IntArray


class SimulatedRecording:
    """A simulated drive (products.Recording). It casts rays only when clouds are requested.

    Attributes:
        seed: seed of all draws.
        guesses: initial guess of T_vehicle_lidar per LiDAR.
        channel_errors: of the LiDARs whose channels have any.
    """

    def __init__(self, scenario: Scenario, seed: int, threads: int = 1) -> None:
        """Draws the errors that hold for the whole drive; the result does not depend on `threads`.

        Raises:
            ConfigError: the seed is negative.
        """
        self.scenario = scenario
        self.seed = seed
        self.world: World = make_world(scenario.world, scenario.vehicle_body)
        self._threads = threads
        self._drawn: dict[tuple[str, int], Drawn] = {}  # by LiDAR and frame
        drive = make_drive(scenario.drive, make_terrain(scenario.world.ground))
        last_ns = round(drive.duration_s * NANOSECONDS_PER_SECOND)
        height_m, heave_m = height_and_heave(
            scenario.suspension,
            last_ns // HEAVE_PERIOD_NS + 1,
            random_stream(seed, Stream.SUSPENSION),
        )
        begin_ns = start_ns(scenario)
        gnss = scenario.gnss
        self.truth = SimulatedTruth(
            T_vehicle_lidar={
                name: model.mounting.pose() for name, model in scenario.lidars.items()
            },
            time_offset_s={name: model.time_offset_s for name, model in scenario.lidars.items()},
            datum=(gnss.latitude_deg, gnss.longitude_deg, gnss.altitude_m),
            start_ns=begin_ns,
            end_ns=begin_ns + last_ns,
            drive=drive,
            level_z_map=self.world.ground_z_map + height_m,
            heave_m=heave_m,
            range_bias_m={
                name: drawn_range_bias_m(model, random_stream(seed, Stream.RANGE_BIAS, index))
                for index, (name, model) in enumerate(scenario.lidars.items())
            },
        )
        self.channel_errors = {
            name: drawn_channel_errors(model, random_stream(seed, Stream.CHANNELS, index))
            for index, (name, model) in enumerate(scenario.lidars.items())
            if model.channel_bias_sigma_m or model.channel_direction_sigma_mrad
        }
        self.guesses: dict[str, PoseConfig] = {
            name: perturbed_extrinsic(
                model.mounting,
                scenario.initial_guess,
                random_stream(seed, Stream.INITIAL_GUESS, index),
            )
            for index, (name, model) in enumerate(scenario.lidars.items())
        }

    @property
    def name(self) -> str:
        """Its name in messages."""
        return f"simulated {self.scenario.name}, seed {self.seed}"

    @property
    def lidars(self) -> tuple[str, ...]:
        """LiDARs in the scenario's order."""
        return tuple(self.scenario.lidars)

    @cached_property
    def imu(self) -> SimulatedImu | None:
        """The IMU's samples with their true biases; None if the vehicle has no IMU."""
        if not self.scenario.imu.enabled:
            return None
        return simulate_imu(self.truth.drive, self.scenario, self.seed)

    @cached_property
    def gnss(self) -> SimulatedGnss | None:
        """Fixes and times without a fix; None if the vehicle has no GNSS receiver."""
        if not self.scenario.gnss.enabled:
            return None
        return simulate_gnss(self.truth.drive, self.scenario, self.truth.level_z_map, self.seed)

    @cached_property
    def _motion(self) -> MotionData:
        velocity = self.scenario.velocity.enabled
        return MotionData(
            name=self.name,
            imu=self.imu.samples if self.imu else None,
            gnss=self.gnss.fixes if self.gnss else None,
            twist=(
                simulate_velocity(self.truth.drive, self.scenario, self.seed) if velocity else None
            ),
        )

    def motion(self) -> MotionData:
        """IMU, GNSS and velocity, those that the scenario has."""
        return self._motion

    def warnings(self) -> Sequence[str]:
        """None: a simulated recording is complete."""
        return ()

    def _frame_stamps(self, lidar: str) -> IntArray:
        """(n,) stamps of the clouds of a LiDAR, counted from the start of the drive."""
        model = self.scenario.lidars[lidar]
        stamps_ns = cloud_stamps(lidar, model, self.truth.drive.duration_s)
        # A sweep that begins before the drive is left out.
        first_ns = 0 if model.stamps_at_start else round(model.sweep_s * NANOSECONDS_PER_SECOND)
        return stamps_ns[stamps_ns >= first_ns]

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending, without casting rays."""
        stamps = self._frame_stamps(lidar) + self.truth.start_ns
        return [int(stamp) for stamp in stamps]

    def complete_ns(self, scan: LidarScan) -> int:
        """Time at which a cloud is complete, in the clock of its stamps: the end of its sweep."""
        return scan.stamp_ns + self._sweep_after_ns(scan.lidar)

    def complete_stamps_ns(self, lidar: str) -> Sequence[int]:
        """`complete_ns` of the clouds of one LiDAR, without casting rays."""
        after_ns = self._sweep_after_ns(lidar)
        return [stamp_ns + after_ns for stamp_ns in self.scan_stamps_ns(lidar)]

    def _sweep_after_ns(self, lidar: str) -> int:
        model = self.scenario.lidars[lidar]
        return round(model.sweep_s * NANOSECONDS_PER_SECOND) if model.stamps_at_start else 0

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster(self.world, self._threads)

    def scans_with_truth(
        self, lidar: str, wanted: Container[int] | None = None
    ) -> Iterator[SimulatedScan]:
        """Like `scans`, with the object of each point."""
        model = self.scenario.lidars[lidar]
        index = list(self.scenario.lidars).index(lidar)
        simulated = SimulatedLidar(
            model,
            self.world,
            self._caster,
            self.scenario.crop,
            random_stream(self.seed, Stream.LIDAR, index),
            self.truth.range_bias_m[lidar],
            self.channel_errors.get(lidar),
        )
        reached = 0
        for frame, stamp_ns in enumerate(self._frame_stamps(lidar).tolist()):
            absolute_ns = stamp_ns + self.truth.start_ns
            if wanted is not None and absolute_ns not in wanted:
                continue
            self._skip(lidar, simulated, reached, frame)
            returns, times_s = self._take(simulated, model, stamp_ns)
            reached = frame + 1
            self._drawn[lidar, reached] = simulated.drawn()
            yield SimulatedScan(
                LidarScan(
                    lidar=lidar,
                    stamp_ns=absolute_ns,
                    points_lidar=returns.points_lidar,
                    source=f"{lidar} at {stamp_ns / NANOSECONDS_PER_SECOND:.3f} s",
                    point_times_s=times_s,
                ),
                frame,
                returns.objects,
            )

    def _skip(self, lidar: str, simulated: SimulatedLidar, first: int, frame: int) -> None:
        """Skips the frames from the `first` to one that is wanted.

        Clouds are asked for several times. Noise that was drawn before is not drawn again.
        """
        known = next((f for f in range(frame, first, -1) if (lidar, f) in self._drawn), first)
        if known > first:
            simulated.continue_from(self._drawn[lidar, known])
        for skipped in range(known, frame):
            simulated.skip()
            self._drawn[lidar, skipped + 1] = simulated.drawn()

    def _take(
        self, simulated: SimulatedLidar, model: LidarModel, stamp_ns: int
    ) -> tuple[LidarReturns, Array | None]:
        """A cloud and its point times after the stamp. The stamp counts from the drive's start."""
        taken_ns, states = self._moments(simulated, model, stamp_ns)
        returns = simulated.sweep(
            states.R_map_vehicle, states.position_map, taken_ns / NANOSECONDS_PER_SECOND
        )
        return returns, self._point_times_s(simulated, model, returns)

    def _moments(
        self, simulated: SimulatedLidar, model: LidarModel, stamp_ns: int
    ) -> tuple[IntArray, VehicleStates]:
        """True times of the columns of a cloud, since the drive's start, and the states there."""
        taken_ns = (
            stamp_ns
            + np.rint(simulated.column_times_s * NANOSECONDS_PER_SECOND).astype(np.int64)
            - round(
                (model.time_offset_s + self._time_jitter_s(model, stamp_ns))
                * NANOSECONDS_PER_SECOND
            )
        )
        heave_m = self.truth.heave_m[stamp_ns // HEAVE_PERIOD_NS]
        return taken_ns, self.truth.drive.states(taken_ns, self.truth.level_z_map + heave_m)

    def _time_jitter_s(self, model: LidarModel, stamp_ns: int) -> float:
        """Stamp of a cloud less its true time, beside the constant offset, seconds."""
        if model.time_jitter_s == 0.0:
            return 0.0
        index = [other is model for other in self.scenario.lidars.values()].index(True)
        rng = random_stream(self.seed, Stream.TIME_JITTER, index, stamp_ns)
        return model.time_jitter_s * float(rng.standard_normal())

    def _point_times_s(
        self, simulated: SimulatedLidar, model: LidarModel, returns: LidarReturns
    ) -> Array | None:
        """(n,) times of the points of a cloud after its stamp; None: all at the stamp."""
        if model.sweep is None:
            return None
        times_s: Array = simulated.column_times_s[simulated.columns_of(returns)]
        return times_s

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps. They do not depend on each other.

        `wanted` has the stamps of the requested clouds; None: all.

        Raises:
            CalivError: open3d cannot be loaded.
        """
        return (taken.scan for taken in self.scans_with_truth(lidar, wanted))


def simulate_drive(scenario: Scenario, seed: int, threads: int = 1) -> SimulatedRecording:
    """Simulates a drive in memory: motion data at once, clouds on request.

    The numbers equal those that `write_drive` writes for the same scenario and seed.

    Raises:
        ConfigError: the seed is negative.
    """
    return SimulatedRecording(scenario, seed, threads)
