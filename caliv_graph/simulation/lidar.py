"""Simulated LiDARs: their beams, what each beam hits, and the range that is reported."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.scenario.beams import channel_elevations_deg, unit_vectors
from caliv_graph.scenario.model import CropModel
from caliv_graph.scenario.sensor_models import EdgeModel, LidarModel
from caliv_graph.scenario.world import World
from caliv_graph.simulation.rays import NO_OBJECT, RayCaster

SingleArray = npt.NDArray[np.float32]

LEAST_COSINE = math.cos(math.radians(80.0))
"""Cosine of the incidence beyond which its range error stays constant; it would become infinite."""


def beam_directions(model: LidarModel) -> Array:
    """Directions of all beams.

    The columns are evenly spaced over the azimuths. Their number is the whole number nearest to
    the requested resolution. Each is in the middle of its slot, so a full turn has no column twice.

    Returns:
        (channels, columns, 3) of length 1, lidar frame.
    """
    elevation = np.radians(channel_elevations_deg(model))[:, None]
    low, high = model.horizontal_fov_deg
    columns = round((high - low) / model.horizontal_resolution_deg)
    azimuth = np.radians(low + (high - low) * (np.arange(columns) + 0.5) / columns)[None, :]
    return unit_vectors(elevation, azimuth)


def beams_through_sphere(directions: Array, centre: Array, radius_m: float) -> BoolArray:
    """Which beams from the origin pass through a sphere.

    Args:
        directions: (..., 3) of length 1.
        centre: (3,) metres, in the frame of the directions, or one for each of their last axis.
        radius_m: radius; every beam passes through a sphere that contains the origin.
    """
    along_m = (
        directions @ centre
        if centre.ndim == 1
        else np.einsum("...ci,ci->...c", directions, centre, optimize=True)
    )
    square = (centre**2).sum(axis=-1)
    ahead = (along_m > 0.0) & (square - along_m**2 <= radius_m**2)
    passes: BoolArray = ahead | (square <= radius_m**2)
    return passes


def column_times(model: LidarModel, columns: int) -> Array:
    """Seconds after the stamp at which each column is taken, to the nanosecond.

    Returns:
        (columns,) in the order of the azimuths, or (1,) zero if all is taken at one instant.
    """
    sweep = model.sweep
    if sweep is None:
        return np.zeros(1)
    part = np.arange(columns) / columns
    times_s = model.sweep_s * (part if sweep.direction == "counter_clockwise" else part[::-1])
    if sweep.stamp_at == "end":
        times_s = times_s - model.sweep_s
    nanoseconds: Array = np.rint(times_s * NANOSECONDS_PER_SECOND)
    return nanoseconds / NANOSECONDS_PER_SECOND


@dataclass(frozen=True)
class ChannelErrors:
    """What the channels of a LiDAR get wrong, the same in every scan; (channels,) each.

    Attributes:
        range_m: reported less true ranges.
        elevation_rad: true less reported elevations.
        azimuth_rad: true less reported azimuths.
    """

    range_m: Array
    elevation_rad: Array
    azimuth_rad: Array


@dataclass(frozen=True)
class LidarReturns:
    """The returns of one scan.

    Attributes:
        points_lidar: (n, 3) metres, lidar frame.
        objects: (n,) index into `World.names` of the object hit; `NO_OBJECT` for a return from
            between two surfaces.
        beams: (n,) index of each beam: its channel times the number of columns, plus its column.
    """

    points_lidar: Array
    objects: IntArray
    beams: IntArray


Drawn = tuple[Mapping[str, Any], Mapping[str, Any]]
"""States of the streams of noise of a LiDAR: of ranges, and of what happens at edges."""


class SimulatedLidar:
    """A LiDAR on the vehicle. Its random generator is the source of its noise only.

    Attributes:
        T_vehicle_lidar: its true extrinsic.
        channels: number of channels.
        columns: number of beams of a channel.
        column_times_s: see `column_times`.
    """

    def __init__(
        self,
        model: LidarModel,
        world: World,
        caster: RayCaster,
        crop: CropModel | None,
        rng: np.random.Generator,
        range_bias_m: float = 0.0,
        channel_errors: ChannelErrors | None = None,
    ) -> None:
        """`range_bias_m` is the error of all ranges on this drive; the model's is not added.

        `channel_errors` are those of this drive; None: channels have none.
        """
        self.T_vehicle_lidar = model.mounting.pose()
        self._model = model
        self._caster = caster
        self._rng = rng
        self._range_bias_m = range_bias_m
        # A separate stream: the range noise is the same with and without edge effects.
        self._edge_rng = rng.spawn(1)[0]
        directions = beam_directions(model)
        self.channels, self.columns = directions.shape[:2]
        self.column_times_s = column_times(model, self.columns)
        reported = directions.reshape(-1, 3)
        true = reported if channel_errors is None else _turned_channels(directions, channel_errors)
        self._directions_lidar, self._reported_lidar = true, reported
        self._beam_bias_m = np.zeros(len(reported))
        if channel_errors is not None:
            self._beam_bias_m = np.repeat(channel_errors.range_m, self.columns)
        self._spheres_map: list[tuple[Array, float]] = []
        always = np.full(directions.shape[:2], crop is None)
        if crop is not None:
            self._spheres_map = [
                (centre, radius_m + crop.margin_m)
                for centre, radius_m in map(world.bounding_sphere, world.targets)
            ]
            if crop.elsewhere_stride:
                always[:: crop.elsewhere_stride, :: crop.elsewhere_stride] = True
        self._always = always.reshape(-1)
        # The vehicle's body does not move in the LiDAR's frame.
        self._vehicle_m, self._vehicle_index = caster.cast_at_vehicle(
            self.T_vehicle_lidar.translation(),
            self._directions_lidar @ self.T_vehicle_lidar.rotation().matrix().T,
        )

    def scan(self, T_map_vehicle: gtsam.Pose3, time_s: float = 0.0) -> LidarReturns:
        """One cloud from one pose, in the order of the beams; `time_s` is for the walkers."""
        return self.sweep(
            T_map_vehicle.rotation().matrix()[None],
            T_map_vehicle.translation()[None],
            np.array([time_s]),
        )

    def skip(self) -> None:
        """Draws the noise of the next cloud and drops it. Later clouds then stay the same."""
        self._draw_noise()
        if self._model.edges is not None:
            self._draw_edges()

    def drawn(self) -> Drawn:
        """How far the noise has been drawn, for `continue_from`."""
        return self._rng.bit_generator.state, self._edge_rng.bit_generator.state

    def continue_from(self, drawn: Drawn) -> None:
        """Goes to where another `SimulatedLidar` of the same drive was, without drawing."""
        self._rng.bit_generator.state, self._edge_rng.bit_generator.state = drawn

    def columns_of(self, returns: LidarReturns) -> IntArray:
        """(n,) column of each return."""
        columns: IntArray = returns.beams % self.columns
        return columns

    def sweep(self, R_map_vehicle: Array, t_map_vehicle: Array, times_s: Array) -> LidarReturns:
        """One cloud, each column taken from its own pose.

        Args:
            R_map_vehicle: (columns, 3, 3) true rotation of the vehicle at each of
                `column_times_s`; (1, 3, 3): one pose for all columns.
            t_map_vehicle: (columns, 3) or (1, 3) metres.
            times_s: (columns,) or (1,) seconds since the start of the drive.
        """
        # Noise is drawn for all beams: cropping does not change the noise of the kept ones.
        noise_m = self._draw_noise()
        edges = None if self._model.edges is None else self._draw_edges()
        towards = self.beams_towards(R_map_vehicle, t_map_vehicle, self._spheres_map)
        beams = np.flatnonzero(self._always | towards)
        return self._returns(
            beams,
            R_map_vehicle,
            t_map_vehicle,
            times_s,
            noise_m[beams],
            None if edges is None else (edges[0][beams], edges[1][beams]),
        )

    def sweep_of(
        self,
        beams: IntArray,
        R_map_vehicle: Array,
        t_map_vehicle: Array,
        times_s: Array,
        rng: np.random.Generator,
    ) -> LidarReturns:
        """Like `sweep`, for some beams only. No noise is drawn for the others.

        Args:
            beams: (n,) ascending indices of beams; the crop is not applied.
            R_map_vehicle: see `sweep`.
            t_map_vehicle: see `sweep`.
            times_s: see `sweep`.
            rng: source of the noise.
        """
        n = len(beams)
        noise_m = self._model.range_sigma_m * rng.standard_normal(n)
        edges = None if self._model.edges is None else _edge_draws(rng, n)
        return self._returns(beams, R_map_vehicle, t_map_vehicle, times_s, noise_m, edges)

    def beams_towards(
        self, R_map_vehicle: Array, t_map_vehicle: Array, spheres_map: Sequence[tuple[Array, float]]
    ) -> BoolArray:
        """(beams,) which beams pass through one of the spheres: centre (3,) in the map, radius."""
        R_map_lidar, t_map_lidar = self._poses(R_map_vehicle, t_map_vehicle)
        kept = np.zeros(len(self._directions_lidar), np.bool_)
        for centre_map, radius_m in spheres_map:
            centres_lidar = np.einsum("cji,cj->ci", R_map_lidar, centre_map - t_map_lidar)
            if len(centres_lidar) == 1:
                kept |= beams_through_sphere(self._directions_lidar, centres_lidar[0], radius_m)
            else:
                grid = self._directions_lidar.reshape(-1, self.columns, 3)
                kept |= beams_through_sphere(grid, centres_lidar, radius_m).reshape(-1)
        return kept

    def _poses(self, R_map_vehicle: Array, t_map_vehicle: Array) -> tuple[Array, Array]:
        """R_map_lidar and t_map_lidar of vehicle poses."""
        return (
            R_map_vehicle @ self.T_vehicle_lidar.rotation().matrix(),
            t_map_vehicle + R_map_vehicle @ self.T_vehicle_lidar.translation(),
        )

    def _returns(
        self,
        beams: IntArray,
        R_map_vehicle: Array,
        t_map_vehicle: Array,
        times_s: Array,
        noise_m: Array,
        edges: tuple[SingleArray, SingleArray] | None,
    ) -> LidarReturns:
        """Returns of some beams, given the noise of each."""
        R_map_lidar, t_map_lidar = self._poses(R_map_vehicle, t_map_vehicle)
        column = np.zeros(1, np.int64) if len(R_map_lidar) == 1 else beams % self.columns
        origin_map, times_s = t_map_lidar[column], times_s[column]

        def turned(directions_lidar: Array) -> Array:
            directions_map: Array = (
                directions_lidar @ R_map_lidar[0].T
                if len(column) == 1
                else np.einsum("nij,nj->ni", R_map_lidar[column], directions_lidar)
            )
            return directions_map

        directions_lidar = self._directions_lidar[beams]
        directions_map = turned(directions_lidar)
        distance_m, objects, normals_map = self._caster.cast_with_normals(
            origin_map, directions_map, times_s
        )
        vehicle_m = self._vehicle_m[beams]
        if self._model.edges is not None and edges is not None:
            normal, uniform = edges
            beside_map = turned(_beside(directions_lidar, self._model.edges, normal))
            aside_m, _ = self._caster.cast(origin_map, beside_map, times_s)
            # Infinite or NaN without a hit or for a grazing beam: there is no such face.
            with np.errstate(divide="ignore", invalid="ignore"):
                faced = np.einsum("ni,ni->n", directions_map, normals_map)
                same_face_m = distance_m * faced / np.einsum("ni,ni->n", beside_map, normals_map)
            distance_m, objects = _at_edges(
                self._model.edges, distance_m, objects, aside_m, same_face_m, uniform
            )
        on_vehicle = vehicle_m < distance_m
        distance_m[on_vehicle] = vehicle_m[on_vehicle]
        objects[on_vehicle] = self._vehicle_index
        # The body of the vehicle is hit squarely.
        cosine = np.where(on_vehicle, 1.0, _cosine(directions_map, normals_map))
        measured_m = distance_m + noise_m + self._bias_m(cosine) + self._beam_bias_m[beams]
        # Infinite where nothing was hit.
        reported = (measured_m >= self._model.min_range_m) & (measured_m <= self._model.max_range_m)
        return LidarReturns(
            points_lidar=self._reported_lidar[beams[reported]] * measured_m[reported, None],
            objects=objects[reported],
            beams=beams[reported],
        )

    def _bias_m(self, cosine: Array) -> Array:
        """(n,) systematic error of ranges in metres, given the cosine of the incidence."""
        along = 1.0 / np.maximum(cosine, LEAST_COSINE) - 1.0
        bias_m: Array = self._range_bias_m + self._model.incidence_bias_m * along
        return bias_m

    def _draw_noise(self) -> Array:
        return self._model.range_sigma_m * self._rng.standard_normal(len(self._directions_lidar))

    def _draw_edges(self) -> tuple[SingleArray, SingleArray]:
        """(beams, 2) normal and (beams, 3) uniform draws."""
        return _edge_draws(self._edge_rng, len(self._directions_lidar))


def _turned_channels(directions: Array, errors: ChannelErrors) -> Array:
    """(channels columns, 3) true directions of beams from reported ones (channels, columns, 3)."""
    x, y, z = np.moveaxis(directions, 2, 0)
    elevation = np.arctan2(z, np.hypot(x, y)) + errors.elevation_rad[:, None]
    azimuth = np.arctan2(y, x) + errors.azimuth_rad[:, None]
    return unit_vectors(elevation, azimuth).reshape(-1, 3)


def _cosine(directions: Array, normals: Array) -> Array:
    """(n,) cosine of the angle between beams and normals (n, 3) of length 1 on either side."""
    cosine: Array = np.abs(np.einsum("ni,ni->n", directions, normals))
    return cosine


def _edge_draws(rng: np.random.Generator, n: int) -> tuple[SingleArray, SingleArray]:
    # Single precision takes half the time, and its resolution is sufficient.
    return rng.standard_normal((n, 2), dtype=np.float32), rng.random((n, 3), dtype=np.float32)


def _beside(directions: Array, edges: EdgeModel, draws: SingleArray) -> Array:
    """(n, 3) directions of a second part of each beam, drawn within the beam's width."""
    # Sigma is a quarter of the full width. The offset is perpendicular to the beam, to first order.
    sigma_rad = 0.25e-3 * edges.divergence_mrad
    horizontal = np.column_stack([-directions[:, 1], directions[:, 0], np.zeros(len(directions))])
    horizontal /= np.maximum(np.linalg.norm(horizontal, axis=1, keepdims=True), 1e-9)
    vertical = np.cross(directions, horizontal)
    moved = directions + sigma_rad * (draws[:, :1] * horizontal + draws[:, 1:] * vertical)
    beside: Array = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    return beside


def _at_edges(
    edges: EdgeModel,
    distance_m: Array,
    objects: IntArray,
    aside_m: Array,
    same_face_m: Array,
    draws: SingleArray,
) -> tuple[Array, IntArray]:
    """(n,) range and object of each beam, given the range `aside_m` of a second part of the beam.

    `same_face_m` is that range if the face in the middle were infinite. With it the long spot of a
    beam that grazes the ground does not count as an edge. `draws` (n, 3) are uniform.
    """
    # Infinite minus infinite is NaN, which is not an edge.
    with np.errstate(invalid="ignore"):
        step_m = aside_m - distance_m
        edge = ~(np.abs(aside_m - same_face_m) <= edges.gap_m) & (np.abs(step_m) > edges.gap_m)
    gap_m = np.abs(step_m)
    lost = (draws[:, 0] < edges.dropout_probability) | (
        edge & (draws[:, 1] < edges.lost_probability)
    )
    # The fraction of the remaining edge returns that merges. Rescaled, the draw is uniform again.
    chosen = (draws[:, 1] - edges.lost_probability) / max(1.0 - edges.lost_probability, 1e-12)
    mixed = edge & ~lost & (gap_m <= edges.mixing_m) & (chosen < edges.mixed_probability)
    distance_m = distance_m + draws[:, 2] * np.where(mixed, step_m, 0.0)
    return np.where(lost, np.inf, distance_m), np.where(mixed | lost, NO_OBJECT, objects)
