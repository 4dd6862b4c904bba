"""From the patches of each drive to what structure says of the calibration's variables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.pose_priors import pose_priors
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.solve import SolveState, solve_registered, with_determined_offsets
from caliv_graph.calibration.structure import nearest_extrinsics
from caliv_graph.config.model import Config
from caliv_graph.products import (
    GroundObservation,
    IntArray,
    PoseNoise,
    Registration,
    StructureTerm,
)
from caliv_graph.registration.symmetry import Symmetry
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.trajectory.select import VehicleTrajectory

KEPT_POSES = 40
"""Poses of a drive without a target that the calibration keeps, for the ground: spread over the
drive, their views of it differ. All other poses of its structure are eliminated before."""

StructureTerms = Callable[
    [
        Sequence[DrivePatches],
        Sequence[PosePrior],
        Sequence[IntArray],
        Sequence[VehicleTrajectory],
        Mapping[str, gtsam.Pose3],
        Config,
        frozenset[str],
        float,
    ],
    tuple[StructureTerm, ...],
]
"""Patches, priors of the poses, stamps of the poses to keep and trajectory of each drive; rough
extrinsics, config, names of the LiDARs with a free time offset, 1
sigma of the heave -> a term per drive."""


def no_terms(*_: object) -> tuple[StructureTerm, ...]:
    """Structure that says nothing."""
    return ()


@dataclass(frozen=True)
class StructureEvidence:
    """What the LiDARs see beside target and ground.

    Attributes:
        patches: per drive.
        solve: how they become terms.
    """

    patches: tuple[DrivePatches, ...] = ()
    solve: StructureTerms = no_terms

    def terms(
        self,
        trajectories: Sequence[VehicleTrajectory],
        kept_ns: Mapping[int, Sequence[int]],
        start: Mapping[str, gtsam.Pose3],
        heave_m: float,
        noise: PoseNoise,
        config: Config,
    ) -> tuple[StructureTerm, ...]:
        """The term of each drive that has structure.

        Args:
            trajectories: one per drive, with nodes at the stamps of the patches.
            kept_ns: drive -> stamps of the poses that the calibration has.
            start: rough T_vehicle_lidar of every LiDAR.
            heave_m: 1 sigma of the heave.
            noise: of given poses.
            config: guesses and noise.

        Raises:
            SolveError: it could not be solved.
        """
        patches = [of for of in self.patches if len(of.scan) and len(kept_ns.get(of.drive, ()))]
        if not patches:
            return ()
        kept = {of.drive: np.asarray(kept_ns[of.drive], np.int64) for of in patches}
        stamps = {
            of.drive: np.unique(np.concatenate([kept[of.drive], of.stamps_ns])) for of in patches
        }
        priors = pose_priors(trajectories, stamps, heave_m, noise, config)
        return self.solve(
            patches,
            [priors[of.drive] for of in patches],
            [kept[of.drive] for of in patches],
            [trajectories[of.drive] for of in patches],
            start,
            config,
            frozenset(config.lidars) if config.solve.time_offset else frozenset(),
            heave_m,
        )

    def terms_beside(
        self,
        state: SolveState,
        problem: Problem,
        trajectories: Sequence[VehicleTrajectory],
        heave_m: float,
    ) -> tuple[StructureTerm, ...]:
        """`terms` on the poses of a problem, from where a rough solve put its LiDARs."""
        kept: dict[int, list[int]] = {}
        for drive, stamp in problem.poses:
            kept.setdefault(drive, []).append(stamp)
        start = {
            name: state.problem.extrinsic(state.values, name)
            if name in state.problem.lidars
            else lidar.guess()
            for name, lidar in state.config.lidars.items()
        }
        return self.terms(trajectories, kept, start, heave_m, state.noise, state.config)


def other_grounds(
    grounds: tuple[GroundObservation, ...], terms: Sequence[StructureTerm]
) -> tuple[GroundObservation, ...]:
    """The ground planes of LiDARs whose ground the terms do not have: it counts once.

    In the terms it is cell by cell. The planes of all LiDARs in its place claim too much: they take
    what scans from other places share of the ground, such as bumps, as independent.
    """
    within = {(term.drive, name) for term in terms for name in term.ground}
    return tuple(o for o in grounds if (o.drive, o.lidar) not in within)


NO_STRUCTURE = StructureEvidence()


def solved_with_structure(
    problem: Problem,
    registrations: Sequence[Registration],
    grounds: tuple[GroundObservation, ...],
    config: Config,
    turns: tuple[Symmetry | None, ...],
    terms: tuple[StructureTerm, ...],
    rough: Mapping[str, gtsam.Pose3],
) -> tuple[SolveState, dict[str, float]]:
    """`solve_registered` with structure, without the time offsets that it leaves undetermined.

    Structure may determine what the target does not: all offsets of the problem are free first.
    `rough` are extrinsics of the LiDARs that saw the target. Also returns LiDAR -> 1 sigma in
    seconds of each offset.
    """
    start = nearest_extrinsics(rough, terms)
    solve = solve_registered(problem, registrations, grounds, config, turns, terms, start)
    problem, sigmas_s = with_determined_offsets(solve, registrations)
    if problem.offsets != solve.problem.offsets:
        solve = solve_registered(problem, registrations, grounds, config, turns, terms, start)
    return solve, sigmas_s


def kept_stamps(patches: Sequence[DrivePatches]) -> dict[int, list[int]]:
    """Per drive with patches, stamps of the poses that a calibration without a target keeps.

    They are those of scans of the LiDAR with most of them, evenly chosen.
    """
    out = {}
    for of in patches:
        if len(of.scan):
            most = int(np.bincount(of.scan_lidar).argmax())
            stamps = np.unique(of.stamps_ns[of.scan_lidar == most])
            chosen = np.linspace(0, len(stamps) - 1, min(KEPT_POSES, len(stamps)))
            out[of.drive] = stamps[np.round(chosen).astype(np.int64)].tolist()
    return out
