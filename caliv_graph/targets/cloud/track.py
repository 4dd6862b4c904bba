"""The static objects among the candidates of a LiDAR's scans."""

from __future__ import annotations

import numpy as np

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, BoolArray, IntArray

SEEDS = 24
"""Candidates from which a track is begun."""

STANDS_STILL_M = 0.35
"""Final gate of a track: the middle of a target's visible points moves by this as one passes it."""

CUT_OFF_M = 0.3
"""The same of a target that is cut off, in addition: by half of what is missing, which is up to a
half of a target 1.2 m wide or high."""

GATE_STEPS = (1.0, 0.5, 0.2, 0.05, 0.0)
"""Factors on the possible error of the guess in the gate, while the error is estimated."""

PLACE_SIGMA_M = 0.1
"""Scatter of the middle of a target's visible points, 1 sigma."""


class CandidateSet:
    """The candidates of all scans of a LiDAR, and how its extrinsic moves them.

    Attributes:
        scan: (n,) index of the scan of each candidate.
        places: (n, 3) metres, region frame, at the guess.
        moves: (n, 3, 6) derivative of the place by a right perturbation of the extrinsic.
        reach_m: (n,) displacement that the guess may cause there.
        prior: (6,) sigmas of the guess, rad and m.
        stands_m: (n,) final gate of each candidate.
    """

    def __init__(
        self, centres_lidar: Array, R: Array, t: Array, scan: IntArray, prior: Array, cut: BoolArray
    ) -> None:
        """Middles (n, 3), metres, at R (n, 3, 3) and t (n, 3) of T_region_lidar, the guess.

        `cut` (n,) candidates are cut off by the edge of the field of view.
        """
        self.scan = scan
        self.places = np.einsum("nij,nj->ni", R, centres_lidar) + t
        self.moves = np.concatenate([-R @ skew(centres_lidar), R], axis=2)
        self.reach_m = 2.0 * (prior[3] + prior[0] * np.linalg.norm(centres_lidar, axis=1))
        self.prior = prior
        self.stands_m = STANDS_STILL_M + np.where(cut, CUT_OFF_M, 0.0)
        self._given = centres_lidar, R, t, cut

    def subset(self, index: IntArray) -> CandidateSet:
        """The candidates at these indices."""
        centres_lidar, R, t, cut = self._given
        return CandidateSet(
            centres_lidar[index], R[index], t[index], self.scan[index], self.prior, cut[index]
        )

    def tracks(self, fewest: int) -> list[IntArray]:
        """Indices of the candidates of each static object with at least `fewest` scans.

        The object of `longest_track` comes first, then that of the longest among the others.
        """
        out: list[IntArray] = []
        free = np.arange(len(self.scan), dtype=np.int64)
        while len(free) >= max(fewest, 1):
            found = free[self.subset(free).longest_track()]
            if len(found) < fewest:
                break
            out.append(found)
            free = np.setdiff1d(free, found)
        return out

    def longest_track(self) -> IntArray:
        """Indices of the candidates of the object that is static in most scans, one per scan."""
        count = len(self.scan)
        seeds = np.linspace(0, count - 1, min(count, SEEDS)).round().astype(int)
        # The best candidates of a scan come first: among equal tracks the larger object wins.
        best: IntArray = max((self.track(int(seed)) for seed in seeds), key=len)
        return best

    def track(self, seed: int) -> IntArray:
        """Indices of the candidates of the same object as candidate `seed`, one per scan."""
        place, error = self.places[seed], np.zeros(6)
        gates = self.stands_m + np.outer(GATE_STEPS, self.reach_m + self.reach_m[seed])
        members = np.array([seed])
        for gate_m in gates:
            off = np.linalg.norm(self.places + self.moves @ error - place, axis=1)
            order = np.lexsort([off, self.scan])
            first = order[np.unique(self.scan[order], return_index=True)[1]]
            members = first[off[first] < gate_m[first]]
            if len(members) < 2:
                return np.asarray(members, np.int64)
            place, error = self._fit(members)
        return np.asarray(members, np.int64)

    def _fit(self, members: IntArray) -> tuple[Array, Array]:
        """Least squares of the object's place (3,) and the error (6,) of the guess."""
        A = np.concatenate(
            [np.tile(np.eye(3), (len(members), 1, 1)), -self.moves[members]], axis=2
        ).reshape(-1, 9)
        prior = np.hstack([np.zeros((6, 3)), np.diag(PLACE_SIGMA_M / self.prior)])
        rows = np.vstack([A, prior])
        right = np.concatenate([self.places[members].ravel(), np.zeros(6)])
        x = np.linalg.lstsq(rows, right, rcond=None)[0]
        return x[:3], x[3:]
