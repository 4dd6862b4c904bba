"""Meshes of things that stand about and could serve as targets: thin parts, flat sides, cloth.

All dimensions are metres. Every mesh is made of closed solids, its origin is on the ground and its
front is +x. None has a rotational symmetry.
"""

from __future__ import annotations

import math

import gtsam
import numpy as np

from caliv_graph.products import Array
from caliv_graph.scenario.solids import (
    Mesh,
    Point,
    bar,
    box,
    cylinder,
    join,
    rectangle,
    solid_between,
    tube,
)

CLOTH_M = 0.015
"""Thickness of cloth, metres: what a LiDAR with 10 mm of noise tells from a single skin."""

LEG = (0.04, 0.04)
"""Section of the thin chair's legs."""

SLAT = (0.02, 0.05)
"""Section of its slats and rails: thickness, width."""


def _placed(mesh: Mesh, xyz: Point, yaw_deg: float) -> Mesh:
    return mesh.moved(gtsam.Pose3(gtsam.Rot3.Yaw(math.radians(yaw_deg)), np.array(xyz)))


def _lean(z: float) -> float:
    """X of the thin chair's back at a height: vertical up to the seat, then leaning back."""
    return -0.24 - 0.04 * max(z - 0.46, 0.0) / 0.49


def thin_chair() -> Mesh:
    """A garden chair of slats: 0.6 x 0.6 x 0.95 m.

    Legs of 4 x 4 cm, slats of 2 x 5 cm, arm rests 2.5 cm thick. It has mirror symmetry between left
    and right.
    """
    thick, wide = SLAT
    parts = []
    for y in (-0.275, 0.275):
        parts += [
            bar((0.28, y, 0.0), (0.28, y, 0.64), LEG, LEG),
            bar((_lean(0.0), y, 0.0), (_lean(0.46), y, 0.46), LEG, LEG),
            bar((_lean(0.46), y, 0.46), (_lean(0.95), y, 0.95), LEG, LEG),
            # Arm rest, and the rail under the seat.
            bar((0.30, y, 0.6475), (-0.25, y, 0.6475), (0.05, 0.025), (0.05, 0.025), (1, 2)),
            bar((0.28, y, 0.415), (-0.24, y, 0.415), SLAT, SLAT, (1, 2)),
        ]

    def across(x: float, z: float, size: tuple[float, float]) -> Mesh:
        return bar((x, -0.275, z), (x, 0.275, z), size, size, (0, 2))

    parts += [across(x, 0.415, SLAT) for x in (0.28, -0.24)]
    parts += [across(_lean(z), z, SLAT) for z in (0.49, 0.925)]
    parts += [across(x, 0.45, (wide, thick)) for x in np.linspace(-0.19, 0.26, 6).tolist()]
    parts += [
        bar((_lean(0.49), y, 0.49), (_lean(0.925), y, 0.925), SLAT, SLAT)
        for y in (-0.195, -0.065, 0.065, 0.195)
    ]
    return join(parts)


def boxes() -> Mesh:
    """Three cardboard boxes: two side by side, turned a little, and one on top of one of them.

    0.65 x 1.07 x 0.65 m.
    """
    return join(
        [
            _placed(box((0.60, 0.40, 0.40)), (0.0, 0.27, 0.0), 8.0),
            _placed(box((0.40, 0.50, 0.32)), (0.03, -0.27, 0.0), -14.0),
            _placed(box((0.40, 0.30, 0.25)), (-0.03, 0.25, 0.40), 31.0),
        ]
    )


def _cone(x: float, y: float, yaw_deg: float) -> Mesh:
    plate = bar((0.0, 0.0, 0.0), (0.0, 0.0, 0.03), (0.36, 0.36), (0.34, 0.34))
    body = cylinder((0.0, 0.0, 0.02), (0.0, 0.0, 0.75), 0.14, 0.025)
    return _placed(join([plate, body]), (x, y, 0.0), yaw_deg)


def _bag() -> Mesh:
    """A full bag that lies: 0.50 x 0.28 x 0.24 m, its edge 0.04 to 0.05 m above the ground."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 13), np.linspace(-1.0, 1.0, 9), indexing="ij")
    # Towards an end it is narrower.
    xy = np.stack([0.25 * u, 0.14 * v * (1.0 - 0.3 * u**2)], axis=-1)
    full = np.sqrt((1.0 - u**4) * (1.0 - v**4))
    upper = np.dstack([xy, 0.05 + 0.19 * full])
    lower = np.dstack([xy, 0.04 * (1.0 - full)])
    return solid_between(upper, lower)


def cones() -> Mesh:
    """Three traffic cones of 0.75 m, and a bag that lies beside them: 0.78 x 1.13 x 0.75 m."""
    return join(
        [
            _cone(-0.15, 0.34, 5.0),
            _cone(0.22, 0.0, -8.0),
            _cone(-0.18, -0.20, 0.0),
            _placed(_bag(), (0.12, -0.42, 0.0), -20.0),
        ]
    )


def _ring(centre: Point, radius_m: float, tyre_radius_m: float) -> Mesh:
    """An upright ring in the xz plane; `radius_m` is that of its outer edge."""
    angle = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)])
    path = np.array(centre) + (radius_m - tyre_radius_m) * circle
    return tube(path, tyre_radius_m, closed=True)


def _tube(radius_m: float, *points: Point, sides: int = 8) -> Mesh:
    return tube(np.array(points, dtype=np.float64), radius_m, sides)


def bicycle() -> Mesh:
    """A bicycle that stands upright: 1.70 x 0.60 x 1.02 m. Tyres and tubes of 3 to 4 cm.

    It has no spokes: a LiDAR sees through them.
    """
    rear, front = (-0.51, 0.0, 0.34), (0.51, 0.0, 0.34)
    crank, seat = (-0.08, 0.0, 0.29), (-0.24, 0.0, 0.80)
    low_head, high_head = (0.38, 0.0, 0.64), (0.31, 0.0, 0.86)
    stem = (0.27, 0.0, 0.99)
    parts = [
        _ring(rear, 0.34, 0.0175),
        _ring(front, 0.34, 0.0175),
        _tube(0.0175, crank, seat),
        _tube(0.02, crank, low_head),
        _tube(0.0175, seat, (0.34, 0.0, 0.77)),
        _tube(0.02, low_head, high_head),
        _tube(0.015, high_head, stem),
        # Handlebar, swept back at both ends; saddle on its post.
        _tube(
            0.015,
            (0.12, -0.285, 0.97), (0.24, -0.26, 1.01), stem,
            (0.24, 0.26, 1.01), (0.12, 0.285, 0.97),
        ),
        _tube(0.015, seat, (-0.27, 0.0, 0.91)),
        bar((-0.39, 0.0, 0.93), (-0.11, 0.0, 0.93), (0.16, 0.06), (0.04, 0.04), (1, 2)),
        # Hubs, chain wheel on the right, cranks and pedals, kickstand on the left.
        _tube(0.02, (-0.51, -0.07, 0.34), (-0.51, 0.07, 0.34)),
        _tube(0.02, (0.51, -0.06, 0.34), (0.51, 0.06, 0.34)),
        _tube(0.09, (-0.08, -0.055, 0.29), (-0.08, -0.04, 0.29), sides=24),
        _tube(0.015, (-0.08, -0.08, 0.29), (0.08, -0.08, 0.25)),
        _tube(0.015, (-0.08, 0.08, 0.29), (-0.24, 0.08, 0.33)),
        _tube(0.015, (-0.08, -0.08, 0.29), (-0.08, 0.08, 0.29)),
        bar((0.08, -0.08, 0.25), (0.08, -0.17, 0.25), (0.09, 0.025), (0.09, 0.025), (0, 2)),
        bar((-0.24, 0.08, 0.33), (-0.24, 0.17, 0.33), (0.09, 0.025), (0.09, 0.025), (0, 2)),
        _tube(0.01, (-0.12, 0.04, 0.27), (-0.16, 0.17, 0.01)),
    ]  # fmt: skip
    for y in (-0.05, 0.05):
        parts += [
            _tube(0.015, crank, (-0.51, y, 0.34)),
            _tube(0.015, seat, (-0.51, y, 0.34)),
            _tube(0.015, (0.39, 0.6 * y, 0.62), (0.51, y, 0.34)),
        ]
    return join(parts)


def _cloth(profile_xz: Array, centre_xz: tuple[float, float], half_width_m: float) -> Mesh:
    """Cloth over a profile: it bulges away from `centre_xz` between its edges at y = -+half width.

    Args:
        profile_xz: (n, 2) the middle of the cloth's inner side.
        centre_xz: a point on its inner side.
        half_width_m: half its width along y.
    """
    along = np.gradient(profile_xz, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    outwards = ((profile_xz - np.array(centre_xz)) * normal).sum(axis=1)
    normal *= np.sign(outwards)[:, None]
    v = np.linspace(-1.0, 1.0, 9)

    def skin(offset_m: float) -> Array:
        depth = offset_m - 0.05 * v**2
        xz = profile_xz[:, None] + depth[:, None] * normal[:, None]
        y = np.broadcast_to(half_width_m * v, xz.shape[:2])
        return np.stack([xz[..., 0], y, xz[..., 1]], axis=-1)

    return solid_between(skin(0.0), skin(CLOTH_M))


def stroller() -> Mesh:
    """A pram: four wheels, tubes of 3 cm, a seat and a hood of cloth; 0.97 x 0.58 x 1.05 m."""
    parts = [
        # Handle, axles, and the tray below the seat.
        _tube(0.015, (-0.47, -0.25, 1.03), (-0.47, 0.25, 1.03)),
        _tube(0.015, (-0.32, -0.25, 0.14), (-0.32, 0.25, 0.14)),
        _tube(0.015, (0.38, -0.20, 0.10), (0.38, 0.20, 0.10)),
        bar((-0.32, 0.0, 0.20), (0.22, 0.0, 0.24), (0.36, CLOTH_M), (0.30, CLOTH_M), (1, 2)),
    ]
    for side in (-1.0, 1.0):
        parts += [
            _tube(
                0.015,
                (0.38, 0.20 * side, 0.10), (0.0, 0.25 * side, 0.55), (-0.47, 0.25 * side, 1.03),
            ),
            _tube(0.015, (-0.32, 0.25 * side, 0.14), (0.08, 0.25 * side, 0.455)),
            _tube(0.14, (-0.32, 0.25 * side, 0.14), (-0.32, 0.29 * side, 0.14), sides=24),
            _tube(0.10, (0.38, 0.20 * side, 0.10), (0.38, 0.24 * side, 0.10), sides=24),
        ]  # fmt: skip
    seat = np.array([[0.36, 0.28], [0.31, 0.40], [0.22, 0.46], [-0.06, 0.43], [-0.28, 0.88]])
    angle = np.radians(np.linspace(55.0, 190.0, 15))
    hood = np.array([-0.11, 0.71]) + 0.30 * np.column_stack([np.cos(angle), np.sin(angle)])
    parts += [_cloth(seat, (0.3, 1.0), 0.22), _cloth(hood, (-0.11, 0.71), 0.23)]
    return join(parts)


def kerbside_bin() -> Mesh:
    """A wheeled bin of 240 litres: 0.74 m deep, 0.58 m wide, 1.07 m high.

    The box widens upwards, the lid slopes to the front and overhangs; wheels and handle are behind.
    """
    lid = rectangle((0.04, 0.0, 0.97), (0.66, 0.58), (0, 1))
    top = rectangle((0.04, 0.0, 1.045), (0.66, 0.58), (0, 1))
    top[:, :, 2] += np.array([[0.025], [-0.025]])
    parts = [
        bar((0.02, 0.0, 0.0), (0.04, 0.0, 0.98), (0.46, 0.48), (0.61, 0.55)),
        solid_between(lid, top),
        _tube(0.015, (-0.355, -0.25, 0.99), (-0.355, 0.25, 0.99)),
        _tube(0.015, (-0.24, -0.22, 0.11), (-0.24, 0.22, 0.11)),
    ]
    for side in (-1.0, 1.0):
        wheel = (-0.26, 0.205 * side, 0.1), (-0.26, 0.265 * side, 0.1)
        parts += [
            _tube(0.015, (-0.25, 0.2 * side, 0.99), (-0.355, 0.2 * side, 0.99)),
            _tube(0.1, *wheel, sides=24),
        ]
    return join(parts)
