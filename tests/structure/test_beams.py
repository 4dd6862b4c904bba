"""Errors of the beams of a LiDAR by elevation."""

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.config.range_errors import UNSTATED
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.structure.beams import (
    CHANNEL_KINDS,
    KINDS,
    NODES,
    BeamErrors,
    BeamNodes,
    SeenBeams,
    beam_groups,
    beam_nodes,
    parts_of,
    seen_beams,
    usual_sigmas,
)
from caliv_graph.structure.channels import PointChannels
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
from tests.structure.yards import (
    TRUE,
    Noise,
    channel_errors,
    channel_of,
    draw_patches,
    figure_eight,
    poses,
    yard,
)

HEIGHT_M = 2.0
UP = np.array([0.0, 0.0, 1.0])
NODES_RAD = np.radians([-40.0, -20.0, -10.0])
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
    own = [np.interp(elevation, NODES_RAD, errors[:, kind]) for kind in range(3)]
    return from_beams(distance + own[0], elevation + own[1], azimuth + own[2])


def from_beams(distance: Array, elevation: Array, azimuth: Array) -> Array:
    """(..., 3) points."""
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=-1
    )


def drive_of(points: Array, channels: PointChannels | None = None) -> DrivePatches:
    """One scan of one LiDAR, with n patches of the points (n, k, 3)."""
    n, k, _ = points.shape
    h = np.concatenate([points, np.ones((n, k, 1))], axis=2)
    by_channel = None
    if channels is not None:
        by_channel = channels.sums(points.reshape(-1, 3).T, np.repeat(np.arange(n), k))
    return DrivePatches(
        drive=0,
        lidars=("lidar",),
        stamps_ns=np.zeros(1, np.int64),
        scan_lidar=np.zeros(1, np.int64),
        scan=np.zeros(n, np.int64),
        time_s=np.zeros(n),
        moments=np.einsum("nki,nkj->nij", h, h),
        normal_lidar=np.zeros((n, 3)),
        scatter_m=np.zeros(n),
        channels=by_channel,
    )


def seen_at_once(patches: DrivePatches, nodes: BeamNodes, normal: Array) -> SeenBeams:
    """All patches in one sighting of a surface with this normal."""
    n = len(patches.scan)
    still = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    groups = beam_groups(patches, (nodes,), np.tile(normal, (n, 1)), *still)
    moments = patches.moments.sum(axis=0)[None]
    return seen_beams(groups, np.arange(n), np.zeros(n, int), np.ones(n), moments, normal[None])


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
        beams = seen_at_once(drive_of(seen), BeamNodes(NODES_RAD), normal)
        added = errors.T.ravel()[beams.column[0]] @ beams.by[0]
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
    errors[:, kind - 3] = rate * (NODES_RAD - centre)
    seen = wrong(points, errors)
    beams = seen_at_once(drive_of(seen), BeamNodes(NODES_RAD), UP)
    assert np.ptp(elevation) > np.radians(0.3)
    added = rate * beams.by[0, beams.column[0] // len(NODES_RAD) == kind].sum(axis=0)
    distance = seen @ UP + HEIGHT_M
    left = distance + seen @ added[:3] + added[3]
    # As far as a patch of 0.2 m shows a tilt: 5 cm are what none does.
    assert np.abs(left).max() < 0.6 * np.abs(distance).max()


def test_nodes_are_where_patches_are() -> None:
    rng = np.random.default_rng(1)
    patches = draw_patches(yard(), poses(*figure_eight(4)), rng)
    for number, of in enumerate(beam_nodes(patches)):
        own = patches.elevations_rad[patches.scan_lidar[patches.scan] == number]
        nodes = of.elevation_rad
        assert of.errors == BeamErrors(len(nodes), KINDS)
        assert 2 < len(nodes) <= NODES
        assert nodes[0] == own.min()
        assert nodes[-1] <= own.max()
        assert (np.diff(nodes) > np.radians(0.49)).all()
    none: DrivePatches = patches.part(patches.scan_lidar[patches.scan] == 0)
    assert [nodes.errors.nodes > 1 for nodes in beam_nodes(none)] == [True, False]


def nees(found: Solved) -> float:
    """Of S2S but its height, which walls do not tell."""
    cov = np.linalg.inv(
        information_of(term_of(found, np.arange(found.layout.poses)), motion_of(found))
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


def sigmas_of(found: Solved) -> list[Array]:
    """1 sigma of the errors of the beams of all LiDARs, of each kind."""
    beams, sigmas = found.layout.beams, found.nuisances.beams
    assert len(sigmas) == sum(errors.size for errors in beams)
    kinds = range(max(errors.kinds for errors in beams))
    return [
        np.concatenate([sigmas[part] for _, of, part in parts_of(beams) if of == kind])
        for kind in kinds
    ]


def test_channels_that_differ_move_no_lidar() -> None:
    """Ranges off by 10 mm from channel to channel, the same in every scan."""
    noise = Noise(bump_m=0.001, bias_m=0.0, channel_m=0.01)
    problem = problem_of(yard(), figure_eight(24), 3, noise)
    problem = replace(problem, patches=replace(problem.patches, channels=None))
    blind = solve(problem)
    found = solve(replace(problem, beam_nodes=beam_nodes(problem.patches)))
    sigmas = sigmas_of(found)
    # Between nodes the errors of several channels have their mean.
    assert 0.002 < np.median(sigmas[0]) < 0.005
    assert np.median(np.concatenate([sigmas[1], sigmas[2]])) < 2e-4
    assert nees(found) < 20.5  # 5 degrees of freedom, one of 1000
    assert nees(blind) > 30.0


def test_each_channel_has_its_error_where_channels_are_seen() -> None:
    """The same, with what the points of each channel add: their ranges are found."""
    noise = Noise(bump_m=0.001, bias_m=0.0, channel_m=0.01)
    problem = problem_of(yard(), figure_eight(14), 3, noise)
    nodes = beam_nodes(problem.patches)
    assert all(of.channels and of.errors.kinds == CHANNEL_KINDS for of in nodes)
    found = solve(replace(problem, beam_nodes=nodes))
    ranges, *directions = sigmas_of(found)
    assert np.median(ranges) == pytest.approx(0.01, rel=0.3)
    assert np.median(np.concatenate(directions)) < 2e-4
    assert nees(found) < 20.5
    for lidar, kind, part in parts_of(found.layout.beams):
        if kind == 0:
            true = channel_errors(noise, lidar)[channel_of(nodes[lidar].elevation_rad)]
            error = found.state.errors[found.layout.beam :][part] - (true - true.mean())
            # Some see little more than the ends of walls.
            assert np.corrcoef(error + true, true)[0, 1] > 0.75
            assert np.median(np.abs(error)) < 0.003


def rings(channels_rad: Array, height_m: float, across: Array) -> Array:
    """(k, n, 3) beams of channels on the ground: distance, elevation, azimuth."""
    elevation = np.repeat(channels_rad[:, None], len(across), axis=1)
    azimuth = np.broadcast_to(across, elevation.shape)
    return np.stack([height_m / np.sin(-elevation), elevation, azimuth], axis=-1)


@pytest.mark.parametrize("kind", range(CHANNEL_KINDS))
@pytest.mark.parametrize("several", [2, 3])
def test_channels_of_a_patch_that_err_to_either_side_tilt_it(kind: int, several: int) -> None:
    """Patches of two and three channels, of errors with alternating signs: each is undone.

    Errors that are linear between elevations, by the middle of each patch, do not see that.
    """
    elevation = np.radians([-17.0, -15.9, -15.0])[:several]
    normal = np.array([0.1, 0.5, 1.0]) / np.linalg.norm([0.1, 0.5, 1.0])  # azimuths count, too
    beams = rings(elevation, HEIGHT_M, np.radians(np.linspace(-2.0, 2.0, 12))).reshape(1, -1, 3)
    true = from_beams(*np.moveaxis(beams, -1, 0))
    true *= (HEIGHT_M / -(true @ normal))[..., None]
    errors = np.zeros((several, KINDS))
    errors[:, kind] = [5e-3, 1e-3, 1e-3][kind] * np.array([1.0, -1.0, 1.0])[:several]
    channel = np.repeat(np.arange(several), 12)
    reported = np.concatenate([np.linalg.norm(true, axis=-1)[..., None], beams[..., 1:]], axis=-1)
    reported[0, :, :] += errors[channel, :3]
    seen = from_beams(*np.moveaxis(reported, -1, 0))
    h = np.column_stack([seen[0], np.ones(len(seen[0]))])
    distance = seen[0] @ normal + HEIGHT_M
    along = np.column_stack([np.ones(len(h)), seen[0] @ np.linalg.svd(normal[None])[2][1:].T])

    def plane(values: Array) -> Array:
        """What a plane along the surface takes of values at the points."""
        return np.asarray(along @ np.linalg.lstsq(along, values, rcond=None)[0])

    left = {}
    for channels in (True, False):
        patches = drive_of(seen, PointChannels(elevation, channel) if channels else None)
        found = seen_at_once(patches, BeamNodes(elevation, channels), normal)
        kinds = CHANNEL_KINDS if channels else KINDS
        added = errors[:, :kinds].T.ravel()[found.column[0]] @ found.by[0]
        left[channels] = np.abs(plane(distance + h @ added)).max()
    most = np.abs(plane(distance)).max()
    assert left[True] < 0.1 * most
    assert left[False] > 0.5 * most


def test_errors_of_lidars_of_both_kinds_stand_apart() -> None:
    beams = (BeamErrors(4, CHANNEL_KINDS), BeamErrors(2, KINDS))
    parts = list(parts_of(beams))
    assert [part.stop - part.start for _, _, part in parts] == [4] * 3 + [2] * 5
    assert parts[-1][2].stop == 22 == sum(errors.size for errors in beams)
    usual = usual_sigmas(beams, UNSTATED)
    assert all((usual[part] == UNSTATED.beams[kind]).all() for _, kind, part in parts)
