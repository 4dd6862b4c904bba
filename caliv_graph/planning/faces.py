"""Flat faces of a scenario's objects: what a LiDAR sees as structure, and what hides it.

Geometry only, no rays. Windows and bumps of a wall are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.surroundings import CAR_HALF_M
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.scenario.world_models import (
    BoxModel,
    BushModel,
    CarModel,
    HedgeModel,
    ObjectModel,
    WallModel,
)
from caliv_graph.structure.planar import PATCH_M

LEAST_WIDTH_M = 1.0
LEAST_HEIGHT_M = 0.5
"""Smallest face that counts: two patches wide, one high."""

CAR_HULL_M = (0.2, 0.85)
"""Lower and upper edge of a car's hull. Its front and back are flat, its sides are curved."""

CAR_END_PART = 0.85
"""Width of a car's front and back as a part of its width."""

NEARLY = 0.999
"""Part of the way to a place up to which a face hides it: not the face that it is on."""


@dataclass(frozen=True)
class Faces:
    """F upright rectangles.

    Attributes:
        names: the object of each.
        centres_map: (F, 3) metres.
        normals_map: (F, 3) unit, outwards.
        half_m: (F, 2) half the length along the object and half the height.
        flat: (F,) whether it is structure; the others only hide what is behind them.
    """

    names: tuple[str, ...]
    centres_map: Array
    normals_map: Array
    half_m: Array
    flat: BoolArray

    @property
    def along_map(self) -> Array:
        """(F, 3) level unit vectors in the faces."""
        x, y = self.normals_map[:, 0], self.normals_map[:, 1]
        return np.stack([-y, x, np.zeros(len(x))], axis=1)

    def hide(self, eye_map: Array, places_map: Array) -> BoolArray:
        """(k,) whether a face stands between an eye (3,) and each place (k, 3)."""
        hidden = np.zeros(len(places_map), dtype=np.bool_)
        beams = places_map - eye_map
        along = self.along_map
        for f in range(len(self.names)):
            normal = self.normals_map[f]
            to_face = float((self.centres_map[f] - eye_map) @ normal)
            if to_face >= 0.0:
                continue  # seen from behind: another face of its object is in front
            with np.errstate(divide="ignore", invalid="ignore"):
                part = to_face / (beams @ normal)
            hit = eye_map + part[:, None] * beams - self.centres_map[f]
            with np.errstate(invalid="ignore"):
                inside = (np.abs(hit @ along[f]) < self.half_m[f, 0]) & (
                    np.abs(hit[:, 2]) < self.half_m[f, 1]
                )
                hidden |= inside & (part > 0.0) & (part < NEARLY)
        return hidden


@dataclass(frozen=True)
class Places:
    """N pieces of surface, of which each scan sees some.

    Attributes:
        centres_map: (N, 3) metres.
        normals_map: (N, 3) unit, outwards.
        half_m: (N, 2) half of their sides.
        axes_map: (N, 2, 3) the directions of these sides, unit vectors.
        face: (N,) the face that each is on; -1: the ground.
    """

    centres_map: Array
    normals_map: Array
    half_m: Array
    axes_map: Array
    face: IntArray


def faces_of(scenario: Scenario) -> Faces:
    """The faces of all objects that stand still and are not targets."""
    terrain = make_terrain(scenario.world.ground)
    found = []
    for name, model in scenario.world.objects.items():
        if name in scenario.world.targets or model.moves:
            continue
        ground_m = scenario.world.ground.height_m
        if terrain is not None:
            ground_m += terrain.height_at(model.xy_m)
        found += [(name, *face) for face in _faces_of_object(model, ground_m)]
    names, centres, normals, halves, flat = zip(*found, strict=True) if found else ((),) * 5
    return Faces(
        tuple(names),
        np.array(centres).reshape(-1, 3),
        np.array(normals).reshape(-1, 3),
        np.array(halves).reshape(-1, 2),
        np.array(flat, dtype=np.bool_),
    )


def _faces_of_object(
    model: ObjectModel, ground_m: float
) -> Iterator[tuple[Array, Array, tuple[float, float], bool]]:
    """Centre, outward normal, half sides of each upright face, and whether it is structure."""
    match model:
        case BoxModel() | HedgeModel() | BushModel():
            (x, y), (low, high) = model.size_m[:2], (0.0, model.size_m[2])
        case WallModel():
            (x, y), (low, high) = (model.length_m, model.thickness_m), (0.0, model.height_m)
        case CarModel():
            (x, y), (low, high) = (2.0 * CAR_HALF_M[0], 2.0 * CAR_HALF_M[1]), CAR_HULL_M
        case _:
            return
    yaw = math.radians(model.yaw_deg)
    middle = np.array([*model.xy_m, ground_m + 0.5 * (low + high)])
    for quarter in range(4):
        heading = yaw + 0.5 * math.pi * quarter
        normal = np.array([math.cos(heading), math.sin(heading), 0.0])
        away, width = (0.5 * x, y) if quarter % 2 == 0 else (0.5 * y, x)
        flat = isinstance(model, BoxModel | WallModel)
        if isinstance(model, CarModel) and quarter % 2 == 0:
            flat, width = True, CAR_END_PART * width
        flat = flat and width >= LEAST_WIDTH_M and high - low >= LEAST_HEIGHT_M
        yield middle + away * normal, normal, (0.5 * width, 0.5 * (high - low)), flat


def face_places(faces: Faces) -> Places:
    """The faces in pieces of about `PATCH_M`."""
    parts: list[tuple[Array, ...]] = []
    up = np.array([0.0, 0.0, 1.0])
    along = faces.along_map
    for f in np.flatnonzero(faces.flat).tolist():
        length, height = 2.0 * faces.half_m[f]
        columns, rows = max(round(length / PATCH_M), 1), max(round(height / PATCH_M), 1)
        u = length * ((np.arange(columns) + 0.5) / columns - 0.5)
        v = height * ((np.arange(rows) + 0.5) / rows - 0.5)
        U, V = (grid.ravel() for grid in np.meshgrid(u, v))
        n = len(U)
        parts.append(
            (
                faces.centres_map[f] + np.outer(U, along[f]) + np.outer(V, up),
                np.tile(faces.normals_map[f], (n, 1)),
                np.tile([0.5 * length / columns, 0.5 * height / rows], (n, 1)),
                np.tile(np.stack([along[f], up]), (n, 1, 1)),
                np.full(n, f),
            )
        )
    if not parts:
        return Places(
            np.zeros((0, 3)),
            np.zeros((0, 3)),
            np.zeros((0, 2)),
            np.zeros((0, 2, 3)),
            np.zeros(0, np.int64),
        )
    return Places(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def ground_places(scenario: Scenario, path_map: Array, reach_m: float) -> Places:
    """The ground in pieces of `PATCH_M` within `reach_m` of a path (m, 3)."""
    low = np.floor((path_map[:, :2].min(axis=0) - reach_m) / PATCH_M)
    high = np.ceil((path_map[:, :2].max(axis=0) + reach_m) / PATCH_M)
    x, y = (PATCH_M * (np.arange(a, b) + 0.5) for a, b in zip(low, high, strict=True))
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    height, slope = np.zeros(len(xy)), np.zeros((len(xy), 2))
    terrain = make_terrain(scenario.world.ground)
    if terrain is not None:
        height, slope, _ = terrain.heights(xy)
    normals = np.column_stack([-slope, np.ones(len(xy))])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    axes = np.zeros((len(xy), 2, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = 1.0
    axes[:, :, 2] = slope
    axes /= np.linalg.norm(axes, axis=2)[:, :, None]
    return Places(
        np.column_stack([xy, scenario.world.ground.height_m + height]),
        normals,
        np.full((len(xy), 2), 0.5 * PATCH_M),
        axes,
        np.full(len(xy), -1),
    )
