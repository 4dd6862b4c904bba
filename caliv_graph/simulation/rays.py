"""Rays cast into a world: the object that each ray hits, and the distance. Uses open3d."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from caliv_graph._open3d import import_open3d
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.solids import Mesh
from caliv_graph.scenario.world import GROUND, World

NO_OBJECT = -1


class RayCaster:
    """Casts rays at a world with Embree; the results do not depend on the number of threads.

    Raises CalivError if open3d cannot be loaded.
    """

    def __init__(self, world: World, threads: int = 1) -> None:
        self._o3d: Any = import_open3d()
        self._threads = threads
        # float32 resolves 1 micrometre at 10 m, but only 30 mm at the 500 km of a UTM grid.
        self._origin_map = _middle(world)
        self._scene = self._scene_of(
            [
                Mesh(mesh.vertices - self._origin_map, mesh.triangles)
                for mesh in world.meshes.values()
            ]
        )
        self._walkers = [
            (len(world.meshes) + i, walker, self._scene_of([walker.mesh]))
            for i, walker in enumerate(world.walkers.values())
        ]
        self._vehicle = None if world.vehicle is None else self._scene_of([world.vehicle])
        self._vehicle_index = len(world.names) - 1

    def _scene_of(self, meshes: Sequence[Mesh]) -> Any:
        scene = self._o3d.t.geometry.RaycastingScene(nthreads=self._threads)
        for mesh in meshes:
            scene.add_triangles(
                self._tensor(mesh.vertices, np.float32), self._tensor(mesh.triangles, np.uint32)
            )
        return scene

    def _tensor(self, values: npt.NDArray[Any], dtype: npt.DTypeLike) -> Any:
        return self._o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=dtype))

    def _hits(self, scene: Any, origin: Array, directions: Array) -> tuple[Array, IntArray, Array]:
        """Distance, index of the mesh in the scene, and normal of its face."""
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origin
        rays[:, 3:] = directions
        answer = scene.cast_rays(self._tensor(rays, np.float32), nthreads=self._threads)
        distance_m = answer["t_hit"].numpy().astype(np.float64)
        normals = answer["primitive_normals"].numpy().astype(np.float64)
        return distance_m, answer["geometry_ids"].numpy().astype(np.int64), normals

    def cast(
        self, origin_map: Array, directions_map: Array, times_s: npt.ArrayLike = 0.0
    ) -> tuple[Array, IntArray]:
        """Casts rays at everything except the vehicle.

        Args:
            origin_map: (3,) or (n, 3) metres.
            directions_map: (n, 3) of length 1.
            times_s: seconds since the start of the drive, one number or (n,), for the walkers.

        Returns:
            (n,) distance in metres, infinite without a hit, and (n,) index into `World.names` of
            the object hit, `NO_OBJECT` without a hit.
        """
        distance_m, objects, _ = self.cast_with_normals(origin_map, directions_map, times_s)
        return distance_m, objects

    def cast_with_normals(
        self, origin_map: Array, directions_map: Array, times_s: npt.ArrayLike = 0.0
    ) -> tuple[Array, IntArray, Array]:
        """Like `cast`, with (n, 3) normals of the faces that were hit, map axes."""
        distance_m, objects, normals = self._hits(
            self._scene, origin_map - self._origin_map, directions_map
        )
        for index, walker, scene in self._walkers:
            times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
            R, t = walker.poses(times)
            own_m, _, own_normals = self._hits(
                scene, _turned(R, origin_map - t), _turned(R, directions_map)
            )
            nearer = own_m < distance_m
            distance_m[nearer] = own_m[nearer]
            objects[nearer] = index
            normals[nearer] = _turned(np.swapaxes(R, 1, 2), own_normals)[nearer]
        objects[~np.isfinite(distance_m)] = NO_OBJECT
        return distance_m, objects, normals

    def cast_at_vehicle(self, origin: Array, directions: Array) -> tuple[Array, int]:
        """(n,) range of the vehicle's body, infinite without a hit, and its index in `World.names`.

        `origin` (3,) is in metres, `directions` (n, 3) are of length 1; vehicle frame.
        """
        if self._vehicle is None:
            return np.full(len(directions), np.inf), self._vehicle_index
        return self._hits(self._vehicle, origin, directions)[0], self._vehicle_index

    def distance(self, points_map: Array) -> Array:
        """(n,) distance in metres of each of (n, 3) points to the nearest static surface."""
        points = self._tensor(points_map - self._origin_map, np.float32)
        distance_m = self._scene.compute_distance(points, nthreads=self._threads)
        result: Array = distance_m.numpy().astype(np.float64)
        return result


def _turned(R_a_b: Array, vectors_a: Array) -> Array:
    """(n, 3) vectors of frame a in frame b; (1, 3, 3) or (n, 3, 3) rotations."""
    turned: Array = (
        vectors_a @ R_a_b[0] if len(R_a_b) == 1 else np.einsum("nji,nj->ni", R_a_b, vectors_a)
    )
    return turned


def _middle(world: World) -> Array:
    """(3,) the middle of the scene in the map: the first target, else the mean of the objects."""
    if world.targets:
        return world.bounding_sphere(world.targets[0])[0]
    standing = [name for name in world.meshes if name != GROUND]
    centres = [world.bounding_sphere(name)[0] for name in standing]
    middle: Array = np.mean(centres, axis=0) if centres else np.zeros(3)
    return middle
