"""Triangle meshes, made in code, of what a scenario can place.

Every solid is closed and has thickness; leaves of hedges and bushes are single triangles. A
backrest with a single skin would let two LiDARs on its two sides agree on a surface that a real
chair does not have.
"""

from __future__ import annotations

import math
from typing import assert_never

import numpy as np

from caliv_graph.scenario.solids import (
    Mesh,
    Point,
    bar,
    box,
    cylinder,
    grid_quads,
    join,
    rectangle,
    solid_between,
)
from caliv_graph.scenario.street_shapes import (
    bicycle,
    boxes,
    cones,
    kerbside_bin,
    stroller,
    thin_chair,
)
from caliv_graph.scenario.surroundings import bush, car, hedge, kerb, wall
from caliv_graph.scenario.terrain import Terrain
from caliv_graph.scenario.world_models import (
    BicycleModel,
    BinModel,
    BoxesModel,
    BoxModel,
    BushModel,
    CarModel,
    ChairModel,
    ConesModel,
    CylinderModel,
    GroundModel,
    HedgeModel,
    KerbModel,
    ObjectModel,
    PoleModel,
    StrollerModel,
    TableModel,
    ThinChairModel,
    WallModel,
)

DRUM_SIDES = 360
"""Sides of a cylinder's mesh. With 24 sides its yaw would be observable to some milliradians."""


def _seat() -> Mesh:
    """Wider in front, dished by 12 mm, 25 mm thick, its top at 0.53 m."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9), indexing="ij")
    half_width = 0.30 + 0.03 * u
    dish = 0.012 * (1.0 - u**2) * (1.0 - v**2)
    # The front edge rolls off.
    roll = 0.03 * np.maximum(u - 0.6, 0.0) ** 2 / 0.16
    top = np.stack([0.015 + 0.295 * u, half_width * v, 0.53 - dish - roll], axis=-1)
    return solid_between(top, top - np.array([0.0, 0.0, 0.025]))


def _backrest() -> Mesh:
    """An arch 0.60 m wide, curved around the sitter, leaning back by 8 degrees, 25 mm thick."""
    v, w = np.meshgrid(np.linspace(-1.0, 1.0, 25), np.linspace(0.0, 1.0, 13), indexing="ij")
    top = 0.80 + 0.45 * np.sqrt(1.0 - 0.97 * v**2)
    z = 0.62 + (top - 0.62) * w
    lean = math.tan(math.radians(8.0)) * (z - 0.53)
    front = np.stack([-0.275 + 0.06 * v**2 - lean, 0.30 * v, z], axis=-1)
    return solid_between(front, front - np.array([0.025, 0.0, 0.0]))


def _side(side: float) -> list[Mesh]:
    """Legs, upright and armrest; `side` is +1 on the left, -1 on the right."""

    def at(x: float, y: float, z: float) -> Point:
        return (x, side * y, z)

    return [
        # Front leg, from the ground past the seat up to the armrest.
        bar(at(0.345, 0.335, 0.0), at(0.245, 0.325, 0.70), (0.055, 0.045), (0.08, 0.035)),
        # Rear leg, and the upright that carries the backrest.
        bar(at(-0.345, 0.315, 0.0), at(-0.245, 0.295, 0.52), (0.055, 0.045), (0.08, 0.035)),
        bar(at(-0.25, 0.295, 0.5), at(-0.265, 0.285, 0.84), (0.065, 0.03), (0.035, 0.025)),
        # Armrest, rising towards the back.
        bar(at(0.285, 0.325, 0.695), at(-0.265, 0.3, 0.765), (0.06, 0.025), (0.05, 0.025), (1, 2)),
    ]


def chair() -> Mesh:
    """A plastic armchair like the CaLiV authors': 0.71 m wide, 0.77 m deep, 1.25 m high.

    Front is +x, the origin is on the ground below the middle of the seat. It has mirror symmetry
    between left and right and no rotational symmetry.
    """
    return join([_seat(), _backrest(), *_side(1.0), *_side(-1.0)])


def table(size_m: Point, top_m: float, leg_m: float) -> Mesh:
    """A table: a top and four square legs at its corners; the origin is on the ground below it."""
    x, y, z = size_m
    top = bar((0.0, 0.0, z - top_m), (0.0, 0.0, z), (x, y), (x, y))
    half_x, half_y = 0.5 * (x - leg_m), 0.5 * (y - leg_m)
    legs = [
        bar((a, b, 0.0), (a, b, z - 0.5 * top_m), (leg_m, leg_m), (leg_m, leg_m))
        for a in (-half_x, half_x)
        for b in (-half_y, half_y)
    ]
    return join([top, *legs])


def person() -> Mesh:
    """A person in mid-step, 1.75 m tall, facing +x, origin on the ground between the feet."""
    return join(
        [
            cylinder((0.22, 0.1, 0.0), (0.0, 0.09, 0.86), 0.06, 0.085),
            cylinder((-0.22, -0.1, 0.0), (0.0, -0.09, 0.86), 0.06, 0.085),
            bar((0.0, 0.0, 0.84), (0.0, 0.0, 1.46), (0.22, 0.34), (0.24, 0.42)),
            bar((-0.2, 0.26, 0.8), (0.0, 0.23, 1.42), (0.09, 0.08), (0.11, 0.09)),
            bar((0.2, -0.26, 0.8), (0.0, -0.23, 1.42), (0.09, 0.08), (0.11, 0.09)),
            cylinder((0.0, 0.0, 1.45), (0.01, 0.0, 1.75), 0.09, 0.08),
        ]
    )


def ground(model: GroundModel, terrain: Terrain | None = None) -> Mesh:
    """Ground around the origin, a square at z = 0 with ramps or bumps on it, facing up.

    It is the only mesh without thickness.
    """
    half_size_m = model.half_size_m
    if terrain is None and model.bumps_sigma_m == 0.0:
        side_m = 2.0 * half_size_m
        square = rectangle((0.0, 0.0, 0.0), (side_m, side_m), (0, 1))
        return Mesh(square.reshape(-1, 3), grid_quads(np.arange(4).reshape(2, 2)))
    if terrain is None:
        cells = math.ceil(2.0 * half_size_m / model.bumps_cell_m)
        line = np.linspace(-half_size_m, half_size_m, cells + 1)
        x, y = np.meshgrid(line, line, indexing="ij")
        draws = np.random.default_rng(model.bumps_seed).standard_normal(x.size)
        heights = model.bumps_sigma_m * draws
    else:
        x, y = np.meshgrid(*terrain.grid_lines(half_size_m), indexing="ij")
        heights = terrain.heights(np.column_stack([x.ravel(), y.ravel()]))[0]
    vertices = np.column_stack([x.ravel(), y.ravel(), heights])
    return Mesh(vertices, grid_quads(np.arange(x.size).reshape(x.shape)))


def object_mesh(model: ObjectModel) -> Mesh:
    """The mesh of an object, in its own frame: origin on the ground, front along +x."""
    match model:
        case ChairModel():
            return chair()
        case ThinChairModel():
            return thin_chair()
        case BoxesModel():
            return boxes()
        case ConesModel():
            return cones()
        case BicycleModel():
            return bicycle()
        case StrollerModel():
            return stroller()
        case BinModel():
            return kerbside_bin()
        case BoxModel():
            return box(model.size_m)
        case PoleModel() | CylinderModel():
            top = (0.0, 0.0, model.height_m)
            sides = 24 if isinstance(model, PoleModel) else DRUM_SIDES
            return cylinder((0.0, 0.0, 0.0), top, model.radius_m, model.radius_m, sides)
        case TableModel():
            return table(model.size_m, model.top_m, model.leg_m)
        case WallModel():
            return wall(model)
        case KerbModel():
            return kerb(model.length_m, model.height_m, model.width_m)
        case CarModel():
            return car()
        case HedgeModel():
            return hedge(model)
        case BushModel():
            return bush(model)
    assert_never(model)
