"""Mounts that slip: is each LiDAR where it was when the drive began?

Everything else of this room takes an extrinsic for constant. Where one is not, S2S ends in between,
and strips, robust weights and noise levels take up the rest. So the change itself is tested at the
estimate, as a variable that the model leaves out (Rao 1948; `README.md`, section 11d).

Variables: the drive is cut into `PARTS` of as many stamps each. In part p > 0 the extrinsic of a
LiDAR is `T_vehicle_lidar Exp(x_p)`, in the first `T_vehicle_lidar`: 6 (PARTS - 1) coordinates per
LiDAR. The derivative by x_p is that by the extrinsic, of sightings in part p alone. A mount that
slips by d at the beginning of part c is `x_p = d` for p >= c. If it slips within a part, the nearer
of its two ends explains most.

Noise: that of the estimate. A clock of each LiDAR is free under its prior, and a jitter of each
stamp if stamps jitter: what a late clock explains is no slip. Each part has an error of each LiDAR
(`ALLOWANCE`) and one of the motion data, the same for all LiDARs (`MOTION_ALLOWANCE`), and all
variances are as large as what the best slip leaves asks for. The slip has a wide prior, so that
directions that nothing tells are zero.

Gauge: none of its own. The extrinsic is free, as is the first part. Poses are as free as in the
solve, under the motion data: if these are weak, the slip of one LiDAR and that of the others the
other way explain the same, and both are named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.sparse
from scipy.special import chdtrc, ndtri

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array, IntArray, MountSlip
from caliv_graph.structure.elimination import Further, Surfaces
from caliv_graph.structure.layout import Layout
from caliv_graph.structure.problem import OFFSET_SIGMA_S, SLIP
from caliv_graph.structure.rows import Rows

PARTS = 8
"""Parts of a drive. Of a slip in the middle of a part a sixteenth of the drive is on the wrong
side: on `street` 0.93 degrees of 1.00 are told of it."""

ALLOWANCE = np.repeat([3e-4, 3e-3], 3)
"""What each part of a drive may have wrong in an extrinsic beyond its sigma, 1 sigma, rad and m.

Clean drives of the second simulator need none: at most 3.0 sigma without (`robot`), 2.8 with
(`meadow`, seed 1). A slip halfway is told from 1.4 mrad on. With 0.5 mrad and 5 mm a degree after a
quarter of `street` has 4.4 sigma in place of 7.3, and 30 mm of height 3.6 in place of 6.3.
"""

SAID_SIGMAS = 4.0
"""From here on a slip is worth the time of a solve that tells its size (`consistency.DOUBT_SIGMAS`,
which is where it is said)."""

MOTION_ALLOWANCE = np.repeat([3e-3, 5e-2], 3)
"""What the motion data may have wrong in each part, all LiDARs alike, about the origin of the
vehicle: slow errors of fixes and side slip are no slips of mounts. On `roundabout` all LiDARs seem
to turn by 3.4 mrad and to shift by 70 mm, 3.5 sigma without, 1.4 with this. The only LiDAR of
`street` has 4 if it slips by a degree halfway, 7 by two. As an error of each LiDAR by itself, the
mean of four would be taken to be twice as good. Which LiDAR slips is asked without.
"""

SAME_SIGMAS = 5.0
"""What is left of a slip with that of another LiDAR freed, up to which either may have slipped: the
limit of every test. On `street` 11 sigma are left of the LiDAR that slips, 2 of the other one."""


@dataclass(frozen=True)
class Coupling:
    """The coordinates of slips (k) beside all D of a system, surfaces included.

    Attributes:
        rows: (k, D) information with them.
        information: (k, k) of their own.
        gradient: (k,).
    """

    rows: scipy.sparse.csr_array
    information: Array
    gradient: Array

    def reduced(self, surfaces: Surfaces) -> Further:
        """The same beside the coordinates that remain when those of the surfaces are eliminated."""
        rows, known, pull = surfaces.reduced(self.rows)
        return Further(rows, self.information - known, self.gradient - pull)


def part_of_scan(stamps_ns: IntArray) -> IntArray:
    """(S,) the part of the drive in which each scan is."""
    stamps, number = np.unique(stamps_ns, return_inverse=True)
    return np.asarray(PARTS * number.ravel() // max(len(stamps), 1), np.int64)


def slip_coupling(
    rows: Rows, layout: Layout, scan_lidar: IntArray, stamps_ns: IntArray
) -> Coupling:
    """What sightings say of slips.

    Args:
        rows: of all sightings.
        layout: the coordinates.
        scan_lidar: (S,) the LiDAR of each scan.
        stamps_ns: (S,).
    """
    part = part_of_scan(stamps_ns)
    first = np.where(part > 0, 6 * ((PARTS - 1) * scan_lidar + part - 1), -1)[rows.scan]
    size, q = 6 * (PARTS - 1) * layout.lidars, len(rows.scan)
    by = rows.J[:, layout.extrinsic : layout.error].tocoo()
    own = first[by.row % q]
    later = own >= 0
    at = by.row[later], own[later] + by.col[later] % 6
    J = scipy.sparse.csr_array((by.data[later], at), shape=(4 * q, size))
    later = first >= 0
    column = first[later, None] + np.arange(6)
    noise = np.bincount(column.ravel(), rows.noise_by_extrinsic[later].ravel(), minlength=size)
    inner = 1.0 / (1.0 + np.asarray(rows.shared.multiply(rows.shared).sum(axis=0)).ravel())
    half = (rows.shared @ scipy.sparse.diags_array(np.sqrt(inner))).tocsr()
    taken = (J - half @ (half.T.tocsr() @ J)).T.tocsr()
    gradient = noise - taken @ rows.r - J.T @ (half @ (np.sqrt(inner) * rows.shared_noise))
    return Coupling((taken @ rows.J).tocsr(), (taken @ J).toarray(), np.asarray(gradient))


@dataclass(frozen=True)
class ToldSlips:
    """What a drive tells of slips, everything else eliminated: a quadratic on all x.

    Attributes:
        lidars: names of the n LiDARs.
        stamps_ns: (S,) of the scans.
        information: (k, k), k = 6 (PARTS - 1) n: LiDAR by LiDAR, of each part by part.
        gradient: (k,).
        T_vehicle_lidar: n poses where it was linearised.
    """

    lidars: tuple[str, ...]
    stamps_ns: IntArray
    information: Array
    gradient: Array
    T_vehicle_lidar: tuple[gtsam.Pose3, ...]

    def slip(self) -> MountSlip:
        """The single slip that explains most, however little that is."""
        n = len(self.lidars)
        each = [(i,) for i in range(n)]
        candidates = [*each, tuple(range(n))] if n > 1 else each
        parts = range(1, PARTS)
        quadratic = self._with_allowance(np.zeros(6))
        found = {
            (who, c): _told(*quadratic, self._moved(who, c)) for who in candidates for c in parts
        }
        own, at = max(found, key=lambda key: found[key].chi_square)
        scale = _scale(*quadratic, found[own, at].chi_square)
        alike = []
        for other in candidates if len(own) == 1 else ():
            if other != own:
                part = max(parts, key=lambda c: found[other, c].chi_square)
                left = _told(*quadratic, self._moved(own, at), self._moved(other, part))
                if left.sigmas(scale) < SAME_SIGMAS:
                    alike.append(other)
        quadratic = self._with_allowance(MOTION_ALLOWANCE)
        told = _told(*quadratic, self._moved(own, at))
        scale = _scale(*quadratic, told.chi_square)
        turned = np.eye(6) if len(own) > 1 else right_to_vehicle_axes(self.T_vehicle_lidar[own[0]])
        stamps = np.unique(self.stamps_ns)
        first = stamps[part_of_scan(stamps) >= at][0] - stamps[0]
        return MountSlip(
            lidars=tuple(self.lidars[i] for i in own),
            others=tuple(self.lidars[who[0]] for who in alike if len(who) == 1),
            since_s=float(first) / NANOSECONDS_PER_SECOND,
            lasts_s=float(stamps[-1] - stamps[0]) / NANOSECONDS_PER_SECOND,
            change=turned @ told.change,
            sigmas=told.sigmas(scale),
            alone=n == 1 or candidates[-1] in alike,
        )

    def _with_allowance(self, motion: Array) -> tuple[Array, Array]:
        """The quadratic (k, k), (k,) if each part, the first included, has errors of its own.

        1 sigma of them is `ALLOWANCE` of each LiDAR, and `motion` (6,) of the motion data, rad and
        m about the origin of the vehicle, which all LiDARs have in common.
        """
        n = len(self.lidars)
        alike = np.concatenate([T.inverse().AdjointMap() for T in self.T_vehicle_lidar])
        of_part = np.diag(np.tile(ALLOWANCE**2, n)) + (alike * motion**2) @ alike.T
        inverse = np.linalg.inv(of_part).reshape(n, 6, n, 6)
        among = np.linalg.inv(np.eye(PARTS - 1) + 1.0)
        known = np.einsum("pq,icjd->ipcjqd", among, inverse).reshape(self.information.shape)
        both = np.column_stack([self.information, self.gradient])
        follow = np.linalg.solve(self.information + known, both)
        H = self.information - self.information @ follow[:, :-1]
        return 0.5 * (H + H.T), self.gradient - self.information @ follow[:, -1]

    def _moved(self, own: Sequence[int], part: int) -> Array:
        """(k, 6) all x by a slip at the beginning of a part: of one LiDAR in its own axes.

        Of several that the vehicle carries alike, about its origin.
        """
        out = np.zeros((len(self.lidars), PARTS - 1, 6, 6))
        for i in own:
            T = self.T_vehicle_lidar[i]
            out[i, part - 1 :] = T.inverse().AdjointMap() if len(own) > 1 else np.eye(6)
        return out.reshape(-1, 6)


def _scale(information: Array, gradient: Array, explained: float) -> float:
    """What the best slip leaves to all others per degree of freedom; 1 at least.

    A mount that swings, or what else the model does not have, differs from part to part to and fro.
    """
    prior = np.diag(np.tile(SLIP**-2.0, len(gradient) // 6))
    follow = np.linalg.solve(information + prior, np.column_stack([information, gradient]))
    free = float(np.trace(follow[:, :-1])) - 6.0
    left = float(gradient @ follow[:, -1]) - explained
    return max(left / max(free, 1.0), 1.0)


@dataclass(frozen=True)
class _Told:
    """An estimate (6,) of a slip, and chi-square of none."""

    change: Array
    chi_square: float

    def sigmas(self, scale: float) -> float:
        """Of a normal variable with the same p-value, variances `scale` times as large."""
        return max(float(-ndtri(0.5 * max(chdtrc(6, self.chi_square / scale), 1e-300))), 0.0)


def _told(information: Array, gradient: Array, moved: Array, freed: Array | None = None) -> _Told:
    """Of a slip along `moved` (k, 6); `freed` (k, 6) is another one that may be there."""
    prior = np.diag(SLIP**-2.0)
    H, b = moved.T @ information @ moved + prior, moved.T @ gradient
    if freed is not None:
        across = moved.T @ information @ freed
        of_freed = freed.T @ information @ freed + prior
        H = H - across @ np.linalg.solve(of_freed, across.T)
        b = b - across @ np.linalg.solve(of_freed, freed.T @ gradient)
    change = np.asarray(np.linalg.solve(H, b), np.float64)
    return _Told(change, float(change @ b))


def told_slips(
    A: Array, u: Array, sigma_s: float, scan_lidar: IntArray, lidars: int
) -> tuple[Array, Array]:
    """Information (k, k) and gradient (k,) of slips, clocks and jitters of stamps eliminated.

    Args:
        A: (S + k, S + k) information on the jitters of all scans, without a prior, and on slips.
        u: (S + k,).
        sigma_s: 1 sigma of the jitters; 0: there are none.
        scan_lidar: (S,) the LiDAR of each scan.
        lidars: number of LiDARs.
    """
    scans = len(scan_lidar)
    late = (scan_lidar[:, None] == np.arange(lidars)).astype(np.float64)
    by, prior = late, np.full(lidars, OFFSET_SIGMA_S**-2.0)
    if sigma_s > 0.0:
        by = np.column_stack([np.eye(scans), late])
        prior = np.concatenate([np.full(scans, sigma_s**-2.0), prior])
    own = by.T @ A[:scans, :scans] @ by + np.diag(prior)
    across, pull = A[scans:, :scans] @ by, by.T @ u[:scans]
    known = np.linalg.solve(own, np.column_stack([across.T, pull]))
    H, b = A[scans:, scans:] - across @ known[:, :-1], u[scans:] - across @ known[:, -1]
    return 0.5 * (H + H.T), b
