"""Structure with a known answer: what walls would say, without any wall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.products import Array, IntArray, MountSlip, Recording, Strip, StructureTerm
from caliv_graph.structure.patches import DrivePatches

SIGMAS = np.array([2e-4] * 3 + [2e-3] * 3)
"""Of what it says, rad and m."""


def patches_of(
    recordings: Sequence[Recording], *_: object, keep_level: bool = False
) -> tuple[DrivePatches, ...]:
    """A patch in every third scan, 5 m ahead: what counts is when they were taken."""
    ahead = np.eye(4)
    ahead[0, [0, 3]] = 5.0**2 + 0.01**2, 5.0
    ahead[3, 0] = 5.0
    out = []
    for drive, recording in enumerate(recordings):
        stamps = [np.array(recording.scan_stamps_ns(n)[1:-1:3], np.int64) for n in recording.lidars]
        count = sum(map(len, stamps))
        out.append(
            DrivePatches(
                drive=drive,
                lidars=tuple(recording.lidars),
                stamps_ns=np.concatenate(stamps),
                scan_lidar=np.repeat(np.arange(len(stamps)), [len(s) for s in stamps]),
                scan=np.arange(count),
                time_s=np.zeros(count),
                moments=np.tile(ahead, (count, 1, 1)),
                normal_lidar=np.tile([1.0, 0.0, 0.0], (count, 1)),
                scatter_m=np.full(count, 0.01),
            )
        )
    return tuple(out)


@dataclass
class Structure:
    """The terms of `StructureTerms` that know the extrinsics, to `SIGMAS`, with errors.

    Attributes:
        truth: T_vehicle_lidar of the LiDARs that see it.
        pairs: only how the LiDARs lie to each other, not to the vehicle.
        slip: of a mount that it would rather have.
        apart_s: stamps of the last LiDAR later than those of the first, to 0.4 ms.
        called: number of calls.
    """

    truth: Mapping[str, gtsam.Pose3]
    pairs: bool = False
    slip: MountSlip | None = None
    apart_s: float = 0.0
    called: int = 0

    def __call__(
        self,
        patches: Sequence[DrivePatches],
        priors: Sequence[object],
        kept_ns: Sequence[IntArray],
        trajectories: Sequence[object],
        start: Mapping[str, gtsam.Pose3],
        *_: object,
    ) -> tuple[StructureTerm, ...]:
        self.called += 1
        assert set(self.truth) <= set(start)
        rng = np.random.default_rng(4)
        names = list(self.truth)
        terms = []
        for of, prior, kept in zip(patches, priors, kept_ns, strict=True):
            stamps = prior.stamps_ns  # type: ignore[attr-defined]
            poses = prior.T_map_vehicle  # type: ignore[attr-defined]
            at = np.searchsorted(stamps, kept)
            assert (stamps[at] == kept).all()
            size = 6 * len(kept) + 6 * len(self.truth)
            information = np.zeros((size, size))
            information[-6 * len(self.truth) :, -6 * len(self.truth) :] = self._of_lidars()
            terms.append(
                StructureTerm(
                    drive=of.drive,
                    stamps_ns=kept,
                    T_map_vehicle=tuple(poses[i] for i in at.tolist()),
                    parameters={},
                    time_offsets_s={},
                    T_vehicle_lidar={
                        n: T.retract(SIGMAS * rng.normal(size=6)) for n, T in self.truth.items()
                    },
                    information=information,
                    gradient=np.zeros(size),
                    strips=self._strips(of.drive),
                    offset_m=0.003,
                    warnings=("a hedge was left out",),
                    slip=self.slip,
                    clocks_apart={(names[0], names[-1]): (self.apart_s, 4e-4)},
                )
            )
        return tuple(terms)

    def _of_lidars(self) -> Array:
        n = len(self.truth)
        if not self.pairs:
            return np.asarray(np.kron(np.eye(n), np.diag(SIGMAS**-2.0)))
        # Each against the first, by left perturbations about the vehicle's origin.
        first, *others = self.truth.values()
        out = np.zeros((6 * n, 6 * n))
        for i, T in enumerate(others, start=1):
            J = np.zeros((6, 6 * n))
            J[:, :6] = -first.AdjointMap()
            J[:, 6 * i : 6 * i + 6] = T.AdjointMap()
            out += J.T @ np.diag(SIGMAS**-2.0) @ J
        return out

    def _strips(self, drive: int) -> tuple[Strip, ...]:
        every = dict.fromkeys(self.truth, 12)
        one = {next(iter(self.truth)): 5}
        return tuple(
            Strip(drive, surface, np.zeros(3), np.eye(3)[0], scans, {}, 0.004, 0.02, weight)
            for surface, scans, weight in (
                (0, every, 1.0),
                (0, every, 0.5),
                (1, one, 1.0),
                (2, every, 0.0),
            )
        )
