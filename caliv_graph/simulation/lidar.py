"""Simulated LiDARs: which beams there are, what they hit, and what is reported of it."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from caliv_graph.geometry.se3 import pose_from_mounting
from caliv_graph.products import Array, IntArray
from caliv_graph.simulation.scenario import CropModel, LidarModel
from caliv_graph.simulation.worlds import RayCaster, World

BoolArray = npt.NDArray[np.bool_]


def beam_directions(model: LidarModel) -> Array:
    """Directions of all beams.

    Channels spread evenly from the lowest to the highest elevation, both included. Columns spread
    evenly over the azimuths, as near to the resolution asked for as a whole number of them allows,
    each in the middle of its slot, so that a full turn has none twice.

    Returns:
        (channels, columns, 3) of length 1, lidar frame.
    """
    elevation = np.radians(np.linspace(*model.vertical_fov_deg, model.channels))[:, None]
    low, high = model.horizontal_fov_deg
    columns = round((high - low) / model.horizontal_resolution_deg)
    azimuth = np.radians(low + (high - low) * (np.arange(columns) + 0.5) / columns)[None, :]
    return np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ),
        axis=-1,
    )


def beams_through_sphere(directions: Array, centre: Array, radius_m: float) -> BoolArray:
    """Which beams from the origin pass through a sphere.

    Args:
        directions: (n, 3) of length 1.
        centre: (3,) metres, in the frame of the directions.
        radius_m: radius; a sphere that holds the origin is met by every beam.
    """
    along_m = directions @ centre
    square = float(centre @ centre)
    if square <= radius_m**2:
        return np.ones(len(directions), dtype=np.bool_)
    passes: BoolArray = (along_m > 0.0) & (square - along_m**2 <= radius_m**2)
    return passes


@dataclass(frozen=True)
class LidarReturns:
    """What a LiDAR reports of one scan.

    Attributes:
        points_lidar: (n, 3) metres, lidar frame.
        objects: (n,) index into `World.names` of what each beam hit.
    """

    points_lidar: Array
    objects: IntArray


class SimulatedLidar:
    """A LiDAR on the vehicle that takes its whole cloud at one instant."""

    def __init__(
        self,
        model: LidarModel,
        world: World,
        caster: RayCaster,
        crop: CropModel | None,
        rng: np.random.Generator,
    ) -> None:
        """Lays out the beams.

        Args:
            model: its characteristics and true mounting.
            world: what stands around it.
            caster: casts at that world.
            crop: which beams to keep; None: all.
            rng: source of its noise, and of nothing else.
        """
        self.T_vehicle_lidar = pose_from_mounting(model.mounting)
        self._model = model
        self._caster = caster
        self._rng = rng
        directions = beam_directions(model)
        self._directions_lidar = directions.reshape(-1, 3)
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

    def scan(self, T_map_vehicle: gtsam.Pose3) -> LidarReturns:
        """One cloud, taken from one pose. The order of the points is that of the beams.

        Args:
            T_map_vehicle: true pose of the vehicle.
        """
        T_map_lidar = T_map_vehicle.compose(self.T_vehicle_lidar)
        # Drawn for all beams, so that cropping leaves the noise of the beams that it keeps alone.
        noise_m = self._model.range_sigma_m * self._rng.standard_normal(len(self._directions_lidar))
        cast = self._always.copy()
        for centre_map, radius_m in self._spheres_map:
            centre_lidar = T_map_lidar.transformTo(centre_map)
            cast |= beams_through_sphere(self._directions_lidar, centre_lidar, radius_m)
        directions_lidar = self._directions_lidar[cast]
        distance_m, objects = self._caster.cast(
            T_map_lidar.translation(), directions_lidar @ T_map_lidar.rotation().matrix().T
        )
        measured_m = distance_m + noise_m[cast]
        # Infinite where nothing was hit.
        reported = (measured_m >= self._model.min_range_m) & (measured_m <= self._model.max_range_m)
        return LidarReturns(
            points_lidar=directions_lidar[reported] * measured_m[reported, None],
            objects=objects[reported],
        )
