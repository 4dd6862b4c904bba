"""Errors of the beams of a LiDAR by elevation."""

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.structure.beams import KINDS, NODES, beam_nodes, elevations, seen_beams
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.solve import Solved
from caliv_graph.structure.term import term_of
from tests.structure.test_solve import (
    GUESS_SIGMAS,
    between,
    information_of,
    motion_of,
    problem_of,
    solve,
)
from tests.structure.yards import TRUE, Noise, draw_patches, figure_eight, poses, yard

HEIGHT_M = 2.0
UP = np.array([0.0, 0.0, 1.0])
NODES_RAD = (np.radians([-40.0, -20.0, -10.0]),)
CELL_M = 0.2


def ground(begin_m: float, end_m: float) -> Array:
    """(n, k, 3) points of level ground below a LiDAR, in n patches from near to far."""
    near = np.arange(begin_m, end_m, CELL_M)
    left = np.arange(-0.5, 0.5, CELL_M)
    x, y = (g.ravel() for g in np.meshgrid(near, left, indexing="ij"))
    u, v = (g.ravel() for g in np.meshgrid(*[np.linspace(0.02, 0.18, 5)] * 2))
    out = np.full((len(x), len(u), 3), -HEIGHT_M)
    out[:, :, 0], out[:, :, 1] = x[:, None] + u, y[:, None] + v
    return out


def wrong(points: Array, errors: Array) -> Array:
    """Points as reported: `errors` (nodes, KINDS), between nodes linear in the elevation."""
    distance = np.linalg.norm(points, axis=-1)
    elevation = np.arcsin(points[..., 2] / distance)
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    own = [np.interp(elevation, NODES_RAD[0], errors[:, kind]) for kind in range(3)]
    distance, elevation, azimuth = distance + own[0], elevation + own[1], azimuth + own[2]
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=-1
    )


def moments_of(points: Array) -> Array:
    h = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)
    return np.asarray(np.einsum("nki,nkj->nij", h, h))


@pytest.mark.parametrize("kind", range(3))
@pytest.mark.parametrize(
    ("shape", "tight"),
    [((1.0, 1.0, 1.0), 0.05), ((0.0, 2.0, 3.0), 0.15), ((0.0, 1.0, 0.0), 0.5)],
    ids=["constant", "linear", "bent"],
)
def test_what_they_add_undoes_the_error_of_every_point(
    kind: int, shape: tuple[float, float, float], tight: float
) -> None:
    """On the ground and on a wall beside, as far as a plane can follow it."""
    errors = np.zeros((3, KINDS))
    errors[:, kind] = np.array(shape) * [5e-3, 1e-3, 1e-3][kind]
    beside = np.stack([np.linspace(4.0, 6.0, 11)] * 3, axis=1)
    beside[:, 1], beside[:, 2] = 5.0, np.linspace(-3.6, -1.2, 11)
    wall = beside[:, None] + np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1], [-0.1, 0.0, 0.1]])
    for points, normal, offset in ((ground(4.0, 6.0), UP, HEIGHT_M), (wall, -np.eye(3)[1], 5.0)):
        seen = wrong(points, errors)
        moments = moments_of(seen)
        centres = moments[:, :3, 3] / moments[:, 3, 3, None]
        n = len(moments)
        beams = seen_beams(
            NODES_RAD,
            np.arctan2(centres[:, 2], np.hypot(centres[:, 0], centres[:, 1])),
            np.zeros(n, dtype=np.int64),
            centres,
            np.tile(normal, (n, 1)),
            moments,
            np.array([0]),
        )
        added = np.einsum("wk,wki->i", errors[beams.node[0]], beams.by[0])
        distance = seen @ normal + offset
        left = distance + seen @ added[:3] + added[3]
        assert np.sqrt((left**2).mean()) < tight * np.sqrt((distance**2).mean()) + 5e-6
        assert abs(left.mean()) < 0.02 * np.abs(distance).mean() + 5e-6


@pytest.mark.parametrize(("kind", "rate"), [(3, 0.5), (4, 0.02)])
def test_a_change_from_channel_to_channel_tilts_a_patch(kind: int, rate: float) -> None:
    """A single patch, whose channels differ by `rate` times their elevations."""
    points = ground(6.0, 6.2)[2:3]
    middle = points.mean(axis=1)[0]
    elevation = np.arcsin(points[..., 2] / np.linalg.norm(points, axis=-1))
    centre = float(np.arctan2(middle[2], np.hypot(middle[0], middle[1])))
    errors = np.zeros((3, KINDS))
    errors[:, kind - 3] = rate * (NODES_RAD[0] - centre)
    seen = wrong(points, errors)
    moments = moments_of(seen)
    beams = seen_beams(
        NODES_RAD,
        np.array([centre]),
        np.zeros(1, dtype=np.int64),
        moments[:, :3, 3] / moments[:, 3, 3, None],
        UP[None],
        moments,
        np.array([0]),
    )
    assert np.ptp(elevation) > np.radians(0.3)
    added = rate * beams.by[0, :, kind].sum(axis=0)
    distance = seen @ UP + HEIGHT_M
    left = distance + seen @ added[:3] + added[3]
    # As far as a patch of 0.2 m shows a tilt: 5 cm are what none does.
    assert np.abs(left).max() < 0.6 * np.abs(distance).max()


def test_nodes_are_where_patches_are() -> None:
    rng = np.random.default_rng(1)
    patches = draw_patches(yard(), poses(*figure_eight(4)), rng)
    for number, nodes in enumerate(beam_nodes(patches)):
        own = elevations(patches)[patches.scan_lidar[patches.scan] == number]
        assert 2 < len(nodes) <= NODES
        assert nodes[0] == own.min()
        assert nodes[-1] <= own.max()
        assert (np.diff(nodes) > np.radians(0.49)).all()
    none: DrivePatches = patches.part(patches.scan_lidar[patches.scan] == 0)
    assert [len(nodes) > 1 for nodes in beam_nodes(none)] == [True, False]


def nees(found: Solved) -> float:
    """Of S2S but its height, which walls do not tell."""
    cov = np.linalg.inv(
        information_of(term_of(found, np.arange(24)), motion_of(found))
        + np.diag(np.tile(GUESS_SIGMAS**-2.0, 2))
    )
    error = np.concatenate(
        [
            vehicle_axes_difference(T, true)
            for T, true in zip(found.state.T_vehicle_lidar, TRUE.values(), strict=True)
        ]
    )
    axes = np.array([between(column) for column in np.eye(12)]).T[:5]
    return float(axes @ error @ np.linalg.solve(axes @ cov @ axes.T, axes @ error))


def test_channels_that_differ_move_no_lidar() -> None:
    """Ranges off by 10 mm from channel to channel, the same in every scan."""
    noise = Noise(bump_m=0.001, bias_m=0.0, channel_m=0.01)
    problem = problem_of(yard(), figure_eight(24), 3, noise)
    blind = solve(problem)
    found = solve(replace(problem, beam_nodes=beam_nodes(problem.patches)))
    assert found.nuisances.beams.shape == (sum(map(len, found.problem.beam_nodes)), KINDS)
    # Between nodes the errors of several channels have their mean.
    assert 0.002 < np.median(found.nuisances.beams[:, 0]) < 0.005
    assert np.median(found.nuisances.beams[:, 1:3]) < 2e-4
    assert nees(found) < 20.5  # 5 degrees of freedom, one of 1000
    assert nees(blind) > 30.0
