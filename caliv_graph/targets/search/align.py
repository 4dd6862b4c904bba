"""The error of a LiDAR's guess in yaw and shift, from the objects that stand still."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray
from caliv_graph.targets.search.history import Alignment, LidarHistory
from caliv_graph.targets.search.objects import WIDE_M

MIN_VIEWS = 3
"""Minimum number of scans of a track."""

GATE_M = 0.5
"""Distance from its place within which an object is associated with a track: half the change of its
visible side, and the effect of roll and pitch of the guess on objects lower than the LiDAR."""

GATES_M = (0.5 * GATE_M, GATE_M)
"""Distances within which two objects count as one, both in a `concentration`."""

ALIGN_STEP_M = 0.2
ALIGN_RANGE_M = 20.0
"""The yaw of a LiDAR is searched in steps that displace objects at `ALIGN_RANGE_M` by
`ALIGN_STEP_M`."""

GUESS_SIGMAS = 2.5
"""Bound of the error of the guess, in sigmas; a uniform error ends at 1.7."""

FAR_SHIFT_M = 1.0
FAR_STEP_M = 0.25
FAR_YAW_RAD = math.radians(6.0)
FAR_YAWS = 13
"""Where the guess is not believed: range and step of the shift, half a vehicle's width and half a
gate; and range and number of yaws about the best without a shift, which a shift of that size moves
by this much at 10 m."""

FAR_RATIO = 1.6
FAR_PAIRS = 20
"""A guess is off if the objects lie at one place this many times as often, and by so many pairs
more, where it is not believed. Measured: 1.8 to 3.0 for 15 degrees and 0.8 m, 1.0 for a guess as
good as its sigma, 1.4 for stamps that are 0.1 s late at 2 m/s."""

FEW = 400
"""Objects up to which all pairs are compared: a tree takes three times as long for 100 of them."""

AT_ONCE = 200_000
"""Squared distances that are held at once: they stay in the processor's cache."""

PLACE_SIGMA_M = 0.2
"""Scatter of the middle of an object's visible points, 1 sigma."""


def align(history: LidarHistory, config: Config) -> Alignment:
    """The yaw and shift of a LiDAR that minimise the motion of its objects in the map.

    On an arc they are correlated: then the smallest correction is taken.
    """
    lidar = config.lidars[history.name]
    usable = history.whole & (history.extent_m < WIDE_M)
    if lidar.fixed or usable.sum() < MIN_VIEWS:
        return Alignment()
    sigma_yaw = lidar.sigma.rpy_rad()[2]
    limit = GUESS_SIGMAS * sigma_yaw
    steps = math.ceil(limit * ALIGN_RANGE_M / ALIGN_STEP_M)
    yaws = limit * np.arange(-steps, steps + 1) / max(steps, 1)
    # Among equal scores the guess decides.
    scores = _concentrations_of_yaws(history, yaws) * (1.0 - 0.02 * (yaws / sigma_yaw) ** 2)
    best = Alignment(float(yaws[np.argmax(scores)]))
    for _ in range(3):
        best = _refined(history, best, config)
    return best


def align_anywhere(history: LidarHistory, config: Config) -> Alignment:
    """The same where the guess is not believed: any yaw, and a shift up to `FAR_SHIFT_M`."""
    if (history.whole & (history.extent_m < WIDE_M)).sum() < MIN_VIEWS:
        return Alignment()

    steps = np.arange(-math.pi, math.pi, ALIGN_STEP_M / ALIGN_RANGE_M)
    about = float(steps[np.argmax(_concentrations_of_yaws(history, steps))])
    near = np.arange(-FAR_SHIFT_M, FAR_SHIFT_M + 0.5 * FAR_STEP_M, FAR_STEP_M)
    turns = about + FAR_YAW_RAD * np.linspace(-1.0, 1.0, FAR_YAWS)
    every = np.stack(np.meshgrid(turns, near, near, indexing="ij"), axis=-1).reshape(-1, 3)
    yaw, *shift_m = every[np.argmax(concentrations(history, every))]
    best = Alignment(float(yaw), np.array(shift_m))
    for _ in range(3):
        best = _refined(history, best, config, np.array([math.pi, FAR_SHIFT_M, FAR_SHIFT_M]))
    return best


def concentration(history: LidarHistory, alignment: Alignment) -> int:
    """How often objects of different scans lie at one place: pairs within a gate, and half of it.

    Twice as often if they stand still as if they smear: this tells a guess that is far off.
    """
    usable = history.whole & (history.extent_m < WIDE_M)
    places = history.bases(alignment, usable)[:, :2]
    if len(places) <= FEW:
        apart2 = pdist(places, "sqeuclidean") if len(places) > 1 else np.zeros(0)
        return 2 * sum(int(np.count_nonzero(apart2 <= gate_m**2)) for gate_m in GATES_M)
    tree = cKDTree(places)
    return int(tree.count_neighbors(tree, np.array(GATES_M)).sum() - len(GATES_M) * len(places))


def concentrations(history: LidarHistory, corrections: Array) -> IntArray:
    """(k,) `concentration` under corrections (k, 3): yaw in radians, shift in metres.

    Places are linear in the cosine and sine of the yaw and in the shift, so squared distances of
    pairs are quadratic in them: one product of matrices gives those of many corrections.
    """
    usable = history.whole & (history.extent_m < WIDE_M)
    if usable.sum() > FEW:
        each = (Alignment(yaw, np.array(shift_m)) for yaw, *shift_m in corrections.tolist())
        return np.array([concentration(history, one) for one in each], dtype=np.int64)
    terms = history.base_terms(usable)
    yaw, x, y = corrections.T
    factors = np.column_stack([np.ones(len(yaw)), np.cos(yaw), np.sin(yaw), x, y])
    first, second = np.triu_indices(len(terms), 1)
    apart = terms[first] - terms[second]
    row, column = np.triu_indices(factors.shape[1])
    twice = np.where(row == column, 1.0, 2.0)
    products = twice * np.einsum("nik,nik->nk", apart[:, :, row], apart[:, :, column])
    of_factors = factors[:, row] * factors[:, column]
    count = np.zeros(len(factors), dtype=np.int64)
    step = max(1, AT_ONCE // max(len(first), 1))
    for begin in range(0, len(factors), step):
        apart2 = of_factors[begin : begin + step] @ products.T
        for gate_m in GATES_M:
            count[begin : begin + step] += np.count_nonzero(apart2 <= gate_m**2, axis=1)
    return 2 * count


def _concentrations_of_yaws(history: LidarHistory, yaws_rad: Array) -> IntArray:
    """(k,) the same under corrections of the yaw alone (k,)."""
    return concentrations(history, np.column_stack([yaws_rad, np.zeros((len(yaws_rad), 2))]))


def _refined(
    history: LidarHistory, alignment: Alignment, config: Config, prior: Array | None = None
) -> Alignment:
    """Least squares of yaw and shift: one place per track, the guess as a prior (rad, m, m)."""
    if prior is None:
        sigma = config.lidars[history.name].sigma
        prior = np.array([sigma.rpy_rad()[2], *sigma.xyz_m()[:2]])
    gate = gate_m(history, config)
    bases = history.bases(alignment)[:, :2]
    J = np.zeros((len(bases), 2, 3))
    J[:, :, 0] = history.levers(alignment)
    J[:, :, 1:] = history.R_map_vehicle[history.scan_of][:, :2, :2]
    now = np.array([alignment.yaw_rad, *alignment.shift_m])
    H, g = np.diag(prior**-2.0), -now / prior**2
    for members in tracks_at_places(history, bases, gate):
        if len(members) < 2 * MIN_VIEWS:
            continue
        # The place is unknown too: its elimination subtracts the means.
        Jc = (J[members] - J[members].mean(axis=0)).reshape(-1, 3)
        r = (bases[members] - bases[members].mean(axis=0)).ravel()
        H += Jc.T @ Jc / PLACE_SIGMA_M**2
        g -= Jc.T @ r / PLACE_SIGMA_M**2
    now = np.clip(now + np.linalg.solve(H, g), -GUESS_SIGMAS * prior, GUESS_SIGMAS * prior)
    return Alignment(float(now[0]), now[1:])


def gate_m(history: LidarHistory, config: Config) -> float:
    """Distance within which an object of an aligned LiDAR is associated with a track, metres."""
    lidar = config.lidars[history.name]
    return GATE_M + (0.0 if lidar.fixed else max(lidar.sigma.xyz_m()))


def tracks_at_places(history: LidarHistory, bases: Array, radius_m: float) -> list[IntArray]:
    """Indices of the objects of each track, one per scan; the place with most scans first.

    `bases` (n, 2), metres, are the places of the objects; `radius_m` is that of a place.
    """
    left = history.whole & (history.extent_m < WIDE_M)
    out = []
    while left.sum() >= MIN_VIEWS:
        index = np.flatnonzero(left)
        tree = cKDTree(bases[index])
        near = tree.query_ball_point(bases[index], radius_m)
        views = [len(np.unique(history.scan_of[index[n]])) for n in near]
        centre = bases[index[int(np.argmax(views))]]
        for _ in range(3):
            members = index[tree.query_ball_point(centre, radius_m)]
            if not len(members):
                break
            centre = np.average(bases[members], axis=0, weights=1.0 / history.range_m[members])
        if not len(members):
            members = index[near[int(np.argmax(views))]]
        # Of two objects in one scan, the one with more points.
        order = np.lexsort((-history.points[members], history.scan_of[members]))
        _, first = np.unique(history.scan_of[members[order]], return_index=True)
        if len(first) < MIN_VIEWS and max(views) < MIN_VIEWS:
            break
        if len(first) >= MIN_VIEWS:
            out.append(np.asarray(members[order[first]]))
        left[members] = False
    return out
