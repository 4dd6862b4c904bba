"""Patches of the vehicle's own body are no structure: they move with it.

A roof, a bonnet or a deck below a LiDAR, seen from beyond `min_range`, is level and faces up, as
the ground does. Wherever the vehicle drives it leaves level strips in the map, above the ground,
and the vehicle seems to stand on them.

A spot of a LiDAR's frame shows the body where two things come together. The LiDAR has a level patch
there, in one plane, in half or more of the places along the drive. And at many of the places of the
map where these patches lie, LiDARs see ground well below them, a little before or after. Real
ground stands still in the frame of a LiDAR as well, on a flat drive all of it, and so do platforms,
decks and pavements beside a straight way: but nothing is seen below them. Walls and ceilings are
not looked at.

Where the ground that is seen is sparse, or none of it lies where the vehicle drives, turns tell the
same: a patch that is far above the stated ground, and stays in one place of a LiDAR's frame while
the vehicle turns, turns with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.read import LEVEL_COS
from caliv_graph.trajectory.select import VehicleTrajectory

PLACE_M = 1.0
"""The vehicle is at another place when it is so far from the one before. What stands around is then
elsewhere in the frame of a LiDAR, by more than `SPOT_M`."""

FEWEST_PLACES = 10
"""Places of a drive with which the body is looked for. A vehicle that stands has one."""

SPOT_M = 0.25
"""Patches of one spot are at most so far apart in the frame of a LiDAR: half the width of
a patch."""

PLANE_M = 0.01
"""They are in one plane to this. On three simulated bodies their middles scatter by 0.5 to 3 mm,
1 sigma, those of the road by 11 to 30 mm: it has waves, and the vehicle rocks and heaves."""

MOST = 0.5
"""Part of the places in which a spot of the body is seen, at least. Of the bodies of three
simulated vehicles most spots have 0.5 to 1.0, those at the edge 0.2 to 0.5."""

CLEAR_PART = 0.25
"""Part of the patches of such a spot below which ground is seen, at least. It is all of them where
ground is dense, 0.3 to 0.45 between trees on a bumpy field. Of the ground itself it is nothing, on
ten drives."""

SOME = 0.2
BESIDE_M = 1.0
"""The body goes on in its plane to spots so far beside it that are seen in this part of the places:
at its edge, where the incidence is at the limit, and where guesses leave open what is below."""

CLEAR_M = 0.3
"""The body is higher than this above the ground that is seen below it. A high kerb, a step or a
speed bump is lower."""

RAISED_M = 0.5
"""Without ground seen below it the body is higher than this above the ground's level."""

GROUND_PART, GROUND_RANGE_M = 0.2, 10.0
"""The ground's level in vehicle axes is the stated one, or the quantile of all level patches so
near, if that is higher: a stated height may be wrong. Half of the patches may be on the body."""

TURNED_RAD = 0.5
"""The vehicle turns by this while a spot is seen: a platform beside its way has left it."""

COLUMN_M = 0.3
"""Ground is looked for in columns of this width about a patch."""

REACH = 2
"""Columns to each side, 25 in all."""

FEWEST_COLUMNS = 8
"""Of these, at least so many have ground below."""

CENTRED_M = 0.15
"""Their mean is so near to the middle of the patch. At the edge of a platform there is ground in
half of the columns, all to one side: the mean of those is 0.3 m away, or more."""

NEAR_M = 10.0
"""Pieces of path of this length: ground counts that is seen from the same one or those beside it.
Over 30 m the height of a trajectory hardly drifts; over a lap it may drift by more than `CLEAR_M`,
and each lap would have the ground of another below it."""

GUESS_SIGMAS = 3.0
"""By so many sigmas of the guesses a patch may be too high and the ground too low. In metres: the
height above the ground that the body must have grows by this times the sigma of the tilts times
both ranges, 0.1 m per metre with the usual 1.7 degrees."""


@dataclass(frozen=True)
class OwnBody:
    """What one LiDAR sees of the vehicle.

    Attributes:
        lidar: its name.
        share: part of its patches in the drive that are on the vehicle.
        reach_m: range of the farthest of them.
    """

    lidar: str
    share: float
    reach_m: float


def without_own_body(
    patches: DrivePatches, trajectory: VehicleTrajectory, config: Config
) -> tuple[DrivePatches, tuple[OwnBody, ...]]:
    """The patches of a drive that are not on the vehicle's own body, and what there was of it.

    Raises:
        TrajectoryError: a scan is outside the trajectory's span.
    """
    path_m, places = _along(patches, trajectory)
    if len(places) < FEWEST_PLACES or not len(patches.scan):
        return patches, ()
    guesses = [configured_guess(config, name) for name in patches.lidars]
    lidar = patches.scan_lidar[patches.scan]
    range_m = np.linalg.norm(patches.centres_lidar, axis=1)
    centres_map, level = _in_map(patches, trajectory, [g.T_vehicle_lidar for g in guesses])
    heights_m, headings = _in_vehicle(patches, trajectory, [g.T_vehicle_lidar for g in guesses])
    tilt = np.array([guess.sigmas[:2].max() for guess in guesses])
    doubt_m = GUESS_SIGMAS * tilt[lidar] * range_m
    near = level & (range_m < GROUND_RANGE_M)
    ground_level_m = np.quantile(heights_m[near], GROUND_PART) if near.any() else np.inf
    stated_m = config.ground.vehicle_height
    # Beside a road on a bank most of what is seen may be lower than the road.
    ground_level_m = np.inf if stated_m is None else max(ground_level_m, -stated_m)
    of_body, found = np.zeros(len(lidar), dtype=bool), []
    for k, name in enumerate(patches.lidars):
        own = np.flatnonzero(level & (lidar == k))
        if not len(own):
            continue
        apart = np.array([0.0 if a == k else np.hypot(g.sigmas[5], guesses[k].sigmas[5])
                          for a, g in enumerate(guesses)])  # fmt: skip
        ground_m = centres_map[:, 2] + doubt_m + GUESS_SIGMAS * apart[lidar]
        column = np.column_stack([centres_map[:, :2] / COLUMN_M, path_m[patches.scan] / NEAR_M])
        limit_m = centres_map[own, 2] - doubt_m[own] - CLEAR_M
        clear = _above_ground(column[own], limit_m, column[level], ground_m[level])
        here = places[patches.scan_lidar[places] == k]
        raised_m = heights_m[own] - doubt_m[own] - GUESS_SIGMAS * guesses[k].sigmas[5]
        raised = raised_m > ground_level_m + RAISED_M
        own = own[_of_body(patches, own, (clear, raised), here, headings)]
        if len(own):
            of_body[own] = True
            share = len(own) / int((lidar == k).sum())
            found.append(OwnBody(name, share, float(range_m[own].max())))
    return (patches.part(~of_body) if found else patches), tuple(found)


def _along(patches: DrivePatches, trajectory: VehicleTrajectory) -> tuple[Array, IntArray]:
    """(M,) metres of path at each scan, and the first scan of each LiDAR at each place."""
    stamps, which = np.unique(patches.stamps_ns, return_inverse=True)
    _, t = trajectory.poses_at(stamps)
    place = np.zeros(len(stamps), dtype=np.int64)
    path_m = np.zeros(len(stamps))
    last = 0
    # The noise of poses, added up over a stop, would be a way.
    for i in range(1, len(stamps)):
        step_m = float(np.linalg.norm(t[i] - t[last]))
        new = step_m >= PLACE_M
        place[i], path_m[i] = place[i - 1] + new, path_m[i - 1] + (step_m if new else 0.0)
        last = i if new else last
    of_scan = place[which] * len(patches.lidars) + patches.scan_lidar
    _, first = np.unique(of_scan, return_index=True)
    return path_m[which], np.asarray(first, dtype=np.int64)


def _in_map(
    patches: DrivePatches, trajectory: VehicleTrajectory, T_vehicle_lidar: Sequence[gtsam.Pose3]
) -> tuple[Array, BoolArray]:
    """Centres (N, 3) of the patches in the map, and whether (N,) they are level and face up."""
    stamps, which = np.unique(patches.taken_ns, return_inverse=True)
    R, t = trajectory.poses_at(stamps)
    R_own, t_own = (a[patches.scan_lidar[patches.scan]] for a in stack(T_vehicle_lidar))
    centres = np.einsum("nij,nj->ni", R_own, patches.centres_lidar) + t_own
    normals = np.einsum("nij,nj->ni", R_own, patches.normal_lidar)
    centres_map = np.einsum("nij,nj->ni", R[which], centres) + t[which]
    return centres_map, np.einsum("nj,nj->n", R[which, 2], normals) > LEVEL_COS


def _in_vehicle(
    patches: DrivePatches, trajectory: VehicleTrajectory, T_vehicle_lidar: Sequence[gtsam.Pose3]
) -> tuple[Array, Array]:
    """(N,) heights of the patches in vehicle axes; (M,) heading at each scan, without jumps."""
    R_own, t_own = (a[patches.scan_lidar[patches.scan]] for a in stack(T_vehicle_lidar))
    heights_m = np.einsum("nj,nj->n", R_own[:, 2], patches.centres_lidar) + t_own[:, 2]
    stamps, which = np.unique(patches.stamps_ns, return_inverse=True)
    R, _ = trajectory.poses_at(stamps)
    return heights_m, np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))[which]


def _above_ground(at: Array, limit_m: Array, ground: Array, ground_m: Array) -> BoolArray:
    """(n,) whether ground lower than `limit_m` (n,) is seen below places, and all about them.

    Places (n, 3) and pieces of ground (m, 3), the latter at heights `ground_m` (m,): map x and y in
    units of `COLUMN_M`, path in units of `NEAR_M`.
    """
    key = _keys(np.floor(ground))
    order = np.lexsort([ground_m, key])
    key, lowest_m = key[order], ground_m[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    key, lowest_m = key[first], lowest_m[first]
    count, sums = np.zeros(len(at)), np.zeros((len(at), 2))
    columns = range(-REACH, REACH + 1)
    for step in itertools.product(columns, columns):
        seen = np.zeros(len(at), dtype=bool)
        for piece in (-1, 0, 1):
            wanted = _keys(np.floor(at) + np.array([*step, piece]))
            found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
            seen |= (key[found] == wanted) & (lowest_m[found] < limit_m)
        count += seen
        sums += seen[:, None] * (np.floor(at[:, :2]) + np.array(step) + 0.5)
    aside = np.linalg.norm(sums / np.maximum(count, 1.0)[:, None] - at[:, :2], axis=1)
    return np.asarray((count >= FEWEST_COLUMNS) & (COLUMN_M * aside < CENTRED_M))


def _keys(cells: Array) -> IntArray:
    """(n,) numbers of cells (n, 3)."""
    part = cells.astype(np.int64) % (1 << 20)
    return np.asarray((part[:, 0] << 40) | (part[:, 1] << 20) | part[:, 2])


def _of_body(
    patches: DrivePatches,
    own: IntArray,
    above: tuple[BoolArray, BoolArray],
    places: IntArray,
    headings: Array,
) -> BoolArray:
    """(n,) which level patches `own` (n,) of one LiDAR are on the vehicle.

    `above` are those (n,) above ground that is seen, and those (n,) far above its level; `places`
    its scans, one of each place; `headings` (M,) those of all scans.
    """
    clear, raised = above
    of_body: BoolArray = np.zeros(len(own), dtype=bool)
    if not (clear | raised).any() or len(places) < FEWEST_PLACES:
        return of_body
    centres, normals = patches.centres_lidar[own], patches.normal_lidar[own]
    tree, scan = cKDTree(centres), patches.scan[own]
    at_place = np.isin(scan, places)

    def in_plane(i: int, radius_m: float) -> IntArray:
        near = np.asarray(tree.query_ball_point(centres[i], radius_m), dtype=np.int64)
        return np.asarray(near[np.abs((centres[near] - centres[i]) @ normals[i]) < PLANE_M])

    def seen(near: IntArray) -> float:
        return len(np.unique(scan[near[at_place[near]]])) / len(places)

    for i in np.flatnonzero(clear | raised).tolist():
        spot = in_plane(i, SPOT_M)
        turns = raised[i] and np.ptp(headings[scan[spot]]) > TURNED_RAD
        is_above = turns or clear[spot].mean() >= CLEAR_PART
        of_body[i] = is_above and seen(spot) >= MOST
    left, tried = np.flatnonzero(of_body).tolist(), of_body.copy()
    while left:
        beside = in_plane(left.pop(), BESIDE_M)
        for i in beside[~tried[beside]].tolist():
            tried[i] = True
            if seen(in_plane(i, SPOT_M)) >= SOME:
                of_body[i] = True
                left.append(i)
    return of_body
