"""The world of a scenario: everything that a beam can hit, and its pose at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from caliv_graph.products import Array
from caliv_graph.scenario.shapes import ground, object_mesh, person
from caliv_graph.scenario.solids import Mesh, box, join
from caliv_graph.scenario.surroundings import car
from caliv_graph.scenario.terrain import Terrain, make_terrain
from caliv_graph.scenario.world_models import BodyBoxModel, WalkerModel, WorldModel

GROUND = "ground"
VEHICLE = "vehicle"

CARRIER_M = 0.45
"""Distance from an object back to the person who carries it."""


@dataclass(frozen=True)
class Walker:
    """A person who walks back and forth, or a car.

    Attributes:
        mesh: in the walker's frame: origin on the ground, x axis in the direction of motion.
        model: path and speed.
        ground_z_map: height of the level ground in metres.
        terrain: the ramps on it.
    """

    mesh: Mesh
    model: WalkerModel
    ground_z_map: float
    terrain: Terrain | None

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """(n, 3, 3) R_map_walker and (n, 3) t_map_walker at (n,) seconds since the start."""
        begin, end = np.array(self.model.from_xy_m), np.array(self.model.to_xy_m)
        length_m = float(np.linalg.norm(end - begin))
        way = np.mod(self.model.speed_m_s * times_s / length_m, 2.0)
        part = np.where(way < 1.0, way, 2.0 - way)
        xy = begin + part[:, None] * (end - begin)
        z = np.full(len(xy), self.ground_z_map)
        if self.terrain is not None:
            z += self.terrain.heights(xy)[0]
        cos, sin = np.where(way < 1.0, 1.0, -1.0) * ((end - begin) / length_m)[:, None]
        return _yaw_matrices(cos, sin), np.column_stack([xy, z])


@dataclass(frozen=True)
class Carried:
    """An object that is carried from place to place, or the person who carries it.

    Attributes:
        mesh: origin on the ground; a person faces the direction of walking.
        begins_s: (m,) start of each move, seconds since the start of the drive.
        ends_s: (m,) end of each move.
        places_map: (m + 1, 3) metres, its place before, between and after the moves.
        yaws_rad: (m + 1,) its heading at each place.
        carrier: whether this is the person, who is behind the object and absent between moves.
    """

    mesh: Mesh
    begins_s: Array
    ends_s: Array
    places_map: Array
    yaws_rad: Array
    carrier: bool = False

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """(n, 3, 3) R_map_mesh and (n, 3) t_map_mesh at (n,) seconds since the start."""
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        done = np.searchsorted(self.ends_s, times, side="right")
        move = np.minimum(done, len(self.begins_s) - 1)
        begin, end = self.begins_s[move], self.ends_s[move]
        part = np.clip((times - begin) / (end - begin), 0.0, 1.0)
        carried = (times > begin) & (times < end)
        way = self.places_map[move + 1] - self.places_map[move]
        place = self.places_map[move] + part[:, None] * way
        yaw = self.yaws_rad[move] + part * (self.yaws_rad[move + 1] - self.yaws_rad[move])
        if self.carrier:
            yaw = np.arctan2(way[:, 1], way[:, 0])
            behind = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
            place = place - CARRIER_M * behind
            # Below the ground no ray reaches the person.
            place[~carried, 2] -= 1000.0
        return _yaw_matrices(np.cos(yaw), np.sin(yaw)), place


def _yaw_matrices(cos: Array, sin: Array) -> Array:
    """(n, 3, 3) rotations about z, from cosine and sine of the yaw (n,)."""
    zeros, ones = np.zeros_like(cos), np.ones_like(cos)
    R: Array = np.stack([cos, -sin, zeros, sin, cos, zeros, zeros, zeros, ones], axis=-1)
    return R.reshape(-1, 3, 3)


@dataclass(frozen=True)
class World:
    """Everything that a beam can hit, by name.

    Attributes:
        meshes: static meshes in the map: the ground first, then the objects.
        targets: names of the objects that serve as targets.
        ground_z_map: height of the level ground in metres.
        walkers: people who walk, cars that drive, and objects that are carried.
        vehicle: the vehicle's body in the vehicle frame; None: it has none.
    """

    meshes: dict[str, Mesh]
    targets: tuple[str, ...]
    ground_z_map: float
    walkers: dict[str, Walker | Carried] = field(default_factory=dict)
    vehicle: Mesh | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of object indices: static meshes, walkers, vehicle."""
        vehicle = () if self.vehicle is None else (VEHICLE,)
        return (*self.meshes, *self.walkers, *vehicle)

    def bounds(self, name: str) -> tuple[Array, Array]:
        """(3,) lower and (3,) upper corner of an object in the map, over all its places."""
        vertices = self._vertices(name)
        return vertices.min(axis=0), vertices.max(axis=0)

    def bounding_sphere(self, name: str) -> tuple[Array, float]:
        """(3,) centre in the map and radius in metres of a sphere around an object, all places."""
        low, high = self.bounds(name)
        centre = 0.5 * (low + high)
        return centre, float(np.linalg.norm(self._vertices(name) - centre, axis=1).max())

    def _vertices(self, name: str) -> Array:
        """(n, 3) metres, map; of a carried object at all its places."""
        moving = self.walkers.get(name)
        if not isinstance(moving, Carried):
            return self.meshes[name].vertices
        return np.vstack(
            [
                moving.mesh.moved(gtsam.Pose3(gtsam.Rot3.Yaw(yaw), place)).vertices
                for place, yaw in zip(moving.places_map, moving.yaws_rad, strict=True)
            ]
        )


def make_world(model: WorldModel, vehicle_body: Sequence[BodyBoxModel] = ()) -> World:
    """The world that a scenario describes, with the boxes that make up the vehicle."""
    z = model.ground.height_m
    terrain = make_terrain(model.ground)
    T_map_ground = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, z]))
    meshes = {GROUND: ground(model.ground, terrain).moved(T_map_ground)}
    walkers: dict[str, Walker | Carried] = {
        name: Walker(car() if who.body == "car" else person(), who, z, terrain)
        for name, who in model.walkers.items()
    }
    for name, placed in model.objects.items():
        stands = [placed, *placed.moves]
        rises = [0.0 if terrain is None else terrain.height_at(s.xy_m) for s in stands]
        places = np.array([[*s.xy_m, z + r] for s, r in zip(stands, rises, strict=True)])
        yaws = np.radians([s.yaw_deg for s in stands])
        if placed.moves:
            begins = np.array([move.begin_s for move in placed.moves])
            ends = np.array([move.end_s for move in placed.moves])
            walkers[name] = Carried(object_mesh(placed), begins, ends, places, yaws)
            walkers[f"who carries {name}"] = Carried(
                person(), begins, ends, places, yaws, carrier=True
            )
        else:
            T_map_object = gtsam.Pose3(gtsam.Rot3.Yaw(float(yaws[0])), places[0])
            meshes[name] = object_mesh(placed).moved(T_map_object)
    parts = [
        box(part.size_m).moved(
            gtsam.Pose3(
                gtsam.Rot3(), np.array(part.centre_m) - np.array([0.0, 0.0, 0.5 * part.size_m[2]])
            )
        )
        for part in vehicle_body
    ]
    return World(
        meshes,
        model.targets,
        z,
        walkers,
        join(parts) if parts else None,
    )
