"""From the patches of each drive to what structure says of the calibration's variables."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import gtsam
import numpy as np

from caliv_graph.calibration.noise import PoseResiduals
from caliv_graph.calibration.pose_priors import given_prior, plain_prior, pose_priors
from caliv_graph.calibration.problem import HEAVE_SIGMA_M, Problem
from caliv_graph.calibration.solve import SolveState, offset_sigmas, solve_registered
from caliv_graph.calibration.structure import nearest_extrinsics
from caliv_graph.common.memory import give_back_freed_memory
from caliv_graph.config.model import Config
from caliv_graph.products import (
    Array,
    GroundObservation,
    IntArray,
    PoseNoise,
    Registration,
    StructureTerm,
    TargetObservation,
)
from caliv_graph.registration.symmetry import Symmetry
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.slow_errors import (
    Tell,
    place_all,
    poses_found,
    scans_for_errors,
    told_of_errors,
    told_of_poses,
)
from caliv_graph.trajectory.effects import poses_and_gain
from caliv_graph.trajectory.error_likelihood import likelihood_end_ns
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

KEPT_POSES = 40
"""Poses of a drive without a target that the calibration keeps, for the ground: spread over the
drive, their views of it differ. All other poses of its structure are eliminated before."""

MOST_BENT = 0.4
"""Part of the scans in which a LiDAR finds the ground bent; beyond, strips alone stand for it."""

MOST_GIVEN = 50
"""Given poses of a drive that its structure tells the errors of: the cost grows with their cube."""

LOOSE = PoseNoise(
    white_rotation_rad=1e-3,
    white_position_m=0.01,
    drift_rotation_rad=2e-3,
    drift_position_m=0.03,
    drift_time_s=10.0,
)
"""Noise of given poses under which structure is solved before it is known: as much as poses are
worth using, so that it does not pass for relief of the walls."""

StructureTerms = Callable[
    [
        Sequence[DrivePatches],
        Sequence[PosePrior],
        Sequence[IntArray],
        Sequence[VehicleTrajectory],
        Mapping[str, gtsam.Pose3],
        Mapping[str, gtsam.Pose3],
        Config,
        frozenset[str],
        float,
        bool,
        frozenset[tuple[int, str]],
    ],
    tuple[StructureTerm, ...],
]
"""Patches, priors of the poses, stamps of the poses to keep and trajectory of each drive; rough
extrinsics, those of them that a target has placed, config, names of the LiDARs with a free time
offset, 1 sigma of the heave, whether the strips lie on each other at these extrinsics, drives and
LiDARs whose ground planes stand where they show few pieces of ground -> a term per drive."""


SlowErrors = Callable[
    [
        Sequence[DrivePatches],
        Sequence[PosePrior],
        Sequence[Tell],
        Sequence[VehicleTrajectory],
        Mapping[str, gtsam.Pose3],
        Mapping[str, gtsam.Pose3],
        Config,
        float,
    ],
    tuple[tuple[tuple[Array, Array] | None, ...], Mapping[str, gtsam.Pose3]],
]
"""Patches, priors of their poses, what is asked and trajectory of each drive; rough extrinsics,
those of them that a target has placed, config, 1 sigma of the heave -> per drive information and
gradient on the errors, and better extrinsics."""


@dataclass(frozen=True)
class ToldErrors:
    """What structure says of errors of the vehicle's sensors or poses.

    Attributes:
        of_drives: drive -> information and gradient.
        T_vehicle_lidar: of every LiDAR, where the strips of these drives lie on each other; None:
            no drive has any.
        aligned: whether they do so for the LiDARs of all drives; else this is only a start.
    """

    of_drives: Mapping[int, tuple[Array, Array]] = field(default_factory=dict)
    T_vehicle_lidar: Mapping[str, gtsam.Pose3] | None = None
    aligned: bool = False


def no_terms(*_: object) -> tuple[StructureTerm, ...]:
    """Structure that says nothing."""
    return ()


NOTHING_TOLD = ToldErrors()


@dataclass(frozen=True)
class _Asked:
    """A drive whose structure is asked for errors: patches of some scans, prior, what is asked."""

    patches: DrivePatches
    prior: PosePrior
    tell: Tell
    trajectory: VehicleTrajectory


@dataclass(frozen=True)
class StructureEvidence:
    """What the LiDARs see beside target and ground.

    Attributes:
        patches: per drive.
        solve: how they become terms.
        errors: what they say of slow errors of the vehicle's sensors.
    """

    patches: tuple[DrivePatches, ...] = ()
    solve: StructureTerms = no_terms
    errors: SlowErrors | None = None

    def slow_errors(
        self,
        trajectories: Sequence[VehicleTrajectory],
        start: Mapping[str, gtsam.Pose3],
        held: Mapping[str, gtsam.Pose3],
        config: Config,
    ) -> ToldErrors:
        """What the structure of smoothed drives says of slow errors of their sensors.

        `start` are rough T_vehicle_lidar of every LiDAR, `held` of those that a target has placed.

        Raises:
            SolveError: it could not be solved.
        """
        if self.errors is None:
            return NOTHING_TOLD
        heave_m = config.noise.heave_m or HEAVE_SIGMA_M
        asked = []
        for patches in self.patches:
            trajectory = trajectories[patches.drive]
            if not isinstance(trajectory, SmoothedTrajectory) or not trajectory.open_kinds:
                continue
            end_ns = likelihood_end_ns(trajectory)
            used = scans_for_errors(patches, end_ns)
            if not len(used.scan):
                continue
            stamps = np.unique(used.stamps_ns)
            # Errors of later steps are taken for none.
            joint, gain = poses_and_gain(trajectory, stamps, trajectory.open_kinds, end_ns)
            prior = plain_prior(joint, stamps, heave_m)
            asked.append(_Asked(used, prior, partial(told_of_errors, gain=gain), trajectory))
        return self._told(asked, start, held, config)

    def poses(
        self,
        trajectories: Sequence[VehicleTrajectory],
        drives: Collection[int],
        start: Mapping[str, gtsam.Pose3],
        held: Mapping[str, gtsam.Pose3],
        config: Config,
    ) -> tuple[ToldErrors, dict[int, IntArray]]:
        """Where the structure of some smoothed drives puts the vehicle; and at which stamps.

        `start` and `held` as for `slow_errors`. Of each drive T_map_vehicle (m, 4, 4) and 1 sigma
        (m,) of the headings, rad. Of some scans, or of all where these are too few: a bent map has
        few places that several scans see alike.

        Raises:
            SolveError: it could not be solved.
        """
        heave_m = config.noise.heave_m or HEAVE_SIGMA_M
        told, stamps_ns = NOTHING_TOLD, dict[int, IntArray]()
        for every in (False, True):
            asked = []
            for patches in self.patches if drives else ():
                trajectory, drive = trajectories[patches.drive], patches.drive
                if drive not in drives or drive in told.of_drives:
                    continue
                used = patches
                if not every:
                    used = scans_for_errors(patches, int(patches.stamps_ns.max(initial=0)))
                if not len(used.scan) or not isinstance(trajectory, SmoothedTrajectory):
                    continue
                stamps_ns[drive] = stamps = np.unique(used.stamps_ns)
                prior = plain_prior(trajectory.joint(stamps), stamps, heave_m)
                asked.append(_Asked(used, prior, poses_found, trajectory))
            found = self._told(asked, told.T_vehicle_lidar or start, held, config)
            if found.T_vehicle_lidar is not None:
                told = replace(found, of_drives={**told.of_drives, **found.of_drives})
        return told, {drive: stamps_ns[drive] for drive in told.of_drives}

    def pose_errors(
        self,
        trajectories: Sequence[VehicleTrajectory],
        start: Mapping[str, gtsam.Pose3],
        config: Config,
    ) -> tuple[ToldErrors, dict[int, IntArray]]:
        """What the structure of drives with given poses says of these; and at which stamps.

        `start` are rough T_vehicle_lidar of every LiDAR. None is held where a target has placed
        it: what that is off by would be an error of all poses.

        Raises:
            SolveError: it could not be solved.
        """
        if self.errors is None:
            return NOTHING_TOLD, {}
        asked, stamps_ns = [], {}
        for patches in self.patches:
            trajectory = trajectories[patches.drive]
            if not isinstance(trajectory, GivenTrajectory) or trajectory.odometry is not None:
                continue
            used = scans_for_errors(patches, int(patches.stamps_ns.max(initial=0)))
            if not len(used.scan):
                continue
            stamps = np.unique(used.stamps_ns)
            chosen = np.arange(0, len(stamps), math.ceil(len(stamps) / MOST_GIVEN))
            stamps_ns[patches.drive] = stamps[chosen]
            prior = given_prior(trajectory, stamps, LOOSE, config)
            asked.append(_Asked(used, prior, partial(told_of_poses, chosen=chosen), trajectory))
        told = self._told(asked, start, {}, config)
        return told, {drive: stamps_ns[drive] for drive in told.of_drives}

    def _told(
        self,
        asked: Sequence[_Asked],
        start: Mapping[str, gtsam.Pose3],
        held: Mapping[str, gtsam.Pose3],
        config: Config,
    ) -> ToldErrors:
        """The answers of the drives that are asked."""
        if not asked or self.errors is None:
            return NOTHING_TOLD
        answers, T_vehicle_lidar = self.errors(
            [of.patches for of in asked],
            [of.prior for of in asked],
            [of.tell for of in asked],
            [of.trajectory for of in asked],
            start,
            held,
            config,
            config.noise.heave_m or HEAVE_SIGMA_M,
        )
        pairs = [(of.patches, told) for of, told in zip(asked, answers, strict=True)]
        by_drive = {patches.drive: told for patches, told in pairs if told is not None}
        if not by_drive:
            return NOTHING_TOLD
        solved = [patches for patches, _ in pairs if patches.drive in by_drive]
        return ToldErrors(by_drive, T_vehicle_lidar, place_all(solved, self.patches))

    def terms(
        self,
        trajectories: Sequence[VehicleTrajectory],
        kept_ns: Mapping[int, Sequence[int]],
        start: Mapping[str, gtsam.Pose3],
        held: Mapping[str, gtsam.Pose3],
        heave_m: float,
        noise: PoseNoise,
        config: Config,
        *,
        aligned: bool = False,
        on_planes: frozenset[tuple[int, str]] = frozenset(),
    ) -> tuple[StructureTerm, ...]:
        """The term of each drive that has structure.

        Args:
            trajectories: one per drive, with nodes at the stamps of the patches.
            kept_ns: drive -> stamps of the poses that the calibration has.
            start: rough T_vehicle_lidar of every LiDAR.
            held: of those that a target has placed.
            heave_m: 1 sigma of the heave.
            noise: of given poses.
            config: guesses and noise.
            aligned: the strips lie on each other at `start` already.
            on_planes: drives and LiDARs whose ground planes stand where pieces are few.

        Raises:
            SolveError: it could not be solved.
        """
        patches = [of for of in self.patches if len(of.scan) and len(kept_ns.get(of.drive, ()))]
        if not patches:
            return ()
        # The largest stage: what smaller ones left behind in pieces would come on top.
        give_back_freed_memory()
        kept = {of.drive: np.asarray(kept_ns[of.drive], np.int64) for of in patches}
        stamps = {
            of.drive: np.unique(np.concatenate([kept[of.drive], of.stamps_ns])) for of in patches
        }
        priors = pose_priors(trajectories, stamps, heave_m, noise, config)
        return self.solve(
            patches,
            [priors.pop(of.drive) for of in patches],
            [kept[of.drive] for of in patches],
            [trajectories[of.drive] for of in patches],
            start,
            held,
            config,
            config.free_offsets(),
            heave_m,
            aligned,
            on_planes,
        )

    def terms_beside(
        self,
        state: SolveState,
        problem: Problem,
        trajectories: Sequence[VehicleTrajectory],
        heave_m: float,
        told: ToldErrors = NOTHING_TOLD,
    ) -> tuple[StructureTerm, ...]:
        """`terms` on the poses of a problem, from where a solve put its LiDARs."""
        kept: dict[int, list[int]] = {}
        for drive, stamp in problem.poses:
            kept.setdefault(drive, []).append(stamp)
        start = told.T_vehicle_lidar or rough_extrinsics(state)
        # A solve that had structure has LiDARs that no target has placed, too.
        placed = {state.problem.lidars[i] for i in state.problem.cloud_lidar.tolist()}
        placed |= state.problem.fixed
        extrinsics = state.problem.extrinsics(state.values)
        return self.terms(
            trajectories,
            kept,
            start,
            {name: T for name, T in extrinsics.items() if name in placed},
            heave_m,
            state.noise,
            state.config,
            aligned=told.aligned,
            # A plane alone does not make a LiDAR part of a calibration: a target has to.
            on_planes=frozenset(
                (o.drive, o.lidar)
                for o in state.grounds
                if o.lidar in placed and o.bent <= MOST_BENT
            ),
        )


def rough_extrinsics(state: SolveState) -> dict[str, gtsam.Pose3]:
    """T_vehicle_lidar of every LiDAR: of a solve, and the guess of those that it is without."""
    guesses = {name: lidar.guess() for name, lidar in state.config.lidars.items()}
    return guesses | state.problem.extrinsics(state.values)


def other_grounds(
    grounds: tuple[GroundObservation, ...], terms: Sequence[StructureTerm]
) -> tuple[GroundObservation, ...]:
    """The ground planes of LiDARs whose ground the terms do not have: it counts once.

    In the terms it is cell by cell. The planes of all LiDARs in its place claim too much: they take
    what scans from other places share of the ground, such as bumps, as independent.

    Planes are none where the ground is bent. A LiDAR that sees it on one side only finds a plane on
    the slope of a cambered road, in all its scans, and it is not that on which the vehicle stands.
    """
    within = {(term.drive, name) for term in terms for name in term.ground}
    drives = {drive for drive, _ in within}
    return tuple(
        o
        for o in grounds
        if (o.drive, o.lidar) not in within and not (o.drive in drives and o.bent > MOST_BENT)
    )


NO_STRUCTURE = StructureEvidence()


def solved_with_structure(
    problem: Problem,
    registrations: Sequence[Registration],
    grounds: tuple[GroundObservation, ...],
    config: Config,
    turns: tuple[Symmetry | None, ...],
    terms: tuple[StructureTerm, ...],
    rough: Mapping[str, gtsam.Pose3],
    of_poses: PoseResiduals | None = None,
) -> tuple[SolveState, dict[str, float]]:
    """`solve_registered` with structure; and LiDAR -> 1 sigma in seconds of each time offset.

    `rough` are extrinsics of the LiDARs that saw the target, `of_poses` what structure says of the
    noise of given poses.
    """
    start = nearest_extrinsics(rough, terms)
    solve = solve_registered(problem, registrations, grounds, config, turns, terms, start, of_poses)
    return solve, offset_sigmas(solve, registrations)


def kept_stamps(
    patches: Sequence[DrivePatches], observations: Sequence[TargetObservation] = ()
) -> dict[int, list[int]]:
    """Per drive with patches and no cloud of a target, stamps of the poses to keep.

    They are those of scans of the LiDAR with most of them, evenly chosen. A drive with clouds has
    their poses; `observations` are the usable ones.
    """
    seen = {cloud.drive for o in observations for cloud in o.clouds}
    out = {}
    for of in patches:
        if len(of.scan) and of.drive not in seen:
            most = int(np.bincount(of.scan_lidar).argmax())
            stamps = np.unique(of.stamps_ns[of.scan_lidar == most])
            chosen = np.linspace(0, len(stamps) - 1, min(KEPT_POSES, len(stamps)))
            out[of.drive] = stamps[np.round(chosen).astype(np.int64)].tolist()
    return out
