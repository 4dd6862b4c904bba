"""From recordings to clouds along a smoothed trajectory, ready to be solved."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.calibration.choose import choose_static, displaced
from caliv_graph.calibration.problem import usable
from caliv_graph.calibration.structure_evidence import kept_stamps
from caliv_graph.calibration.suspect_values import motion_suspects
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, TargetError, TrajectoryError
from caliv_graph.mounting.doubts import Doubt
from caliv_graph.mounting.place import Placement, place_lidars
from caliv_graph.odometry.run import with_odometry
from caliv_graph.physics import (
    check_clouds,
    heading_findings,
    raise_fatal,
    raw_findings,
    smoothed_findings,
    warnings_of,
    with_cause,
)
from caliv_graph.pipeline.mistakes import mistakes, without_remedies
from caliv_graph.pipeline.standing import with_standing
from caliv_graph.products import (
    Finding,
    GroundObservation,
    MotionData,
    Recording,
    TargetObservation,
)
from caliv_graph.readers.empty import CountedRecording
from caliv_graph.readers.pose_pauses import without_pauses
from caliv_graph.readers.without_times import without_times
from caliv_graph.structure.deskewed import motion_left
from caliv_graph.structure.own_body import without_own_body
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.range_noise import with_range_noise
from caliv_graph.structure.read import ground_roughness_m, read_patches
from caliv_graph.structure.without_targets import without_targets
from caliv_graph.targets.cloud.extract import extract_targets
from caliv_graph.targets.ground.measure import measure_grounds, roughness_m
from caliv_graph.targets.search import find_target
from caliv_graph.targets.search.misplaced import realigned
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.trajectory.select import (
    VehicleTrajectory,
    are_given,
    sharing_poses,
    smooth_trajectories,
    takes_given_poses,
)
from caliv_graph.wording.mounting import (
    mistake_sentence,
    placement_sentence,
    region_sentence,
)
from caliv_graph.wording.odometry import odometry_sentence
from caliv_graph.wording.structure import (
    deskewed_sentence,
    no_target_sentence,
    own_body_sentence,
    rough_ground_sentence,
)
from caliv_graph.wording.suspects import motion_sentence


@dataclass(frozen=True)
class Prepared:
    """Recorded drives, ready to be solved.

    Attributes:
        trajectories: one per drive, with a node at every scan that sees a target.
        observations: the targets' clouds.
        grounds: the ground as the LiDARs saw it.
        findings: values of the config that the raw data contradict.
        warnings: for the user, a line each.
        config: the config, with the guesses that the search for the target had to replace, and a
            larger sigma of the height on grass.
        contradictions: how guesses and stamps contradict what the LiDARs see, a sentence each.
        patches: pieces of walls and other surfaces, per drive; empty: structure is not used.
        no_target: why no target was found; None: one was, or none was to be looked for.
        mistakes: of the config, that explain why LiDARs do not see the target, a sentence each.
        misplaced: beside `contradictions`, those of guesses that the search had to replace.
    """

    trajectories: tuple[VehicleTrajectory, ...]
    observations: tuple[TargetObservation, ...]
    grounds: tuple[GroundObservation, ...]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    config: Config
    contradictions: tuple[str, ...] = ()
    patches: tuple[DrivePatches, ...] = ()
    no_target: TargetError | None = None
    mistakes: tuple[str, ...] = ()
    misplaced: tuple[str, ...] = ()

    def without_clouds(self, lidars: Collection[str]) -> Prepared:
        """The same without the target's clouds of some LiDARs, and targets of fewer than two."""
        left = [
            replace(of, clouds=tuple(cloud for cloud in of.clouds if cloud.lidar not in lidars))
            for of in self.observations
        ]
        return replace(self, observations=tuple(of for of in left if len(of.clouds) >= 2))


def motions_of(
    recordings: Sequence[Recording], config: Config, progress: Progress
) -> tuple[dict[int, MotionData], Config, tuple[str, ...]]:
    """The motion data of drives; by the odometry of a LiDAR where nothing else was recorded.

    Returns:
        The motion data by the index of the drive; the config for them; what to tell the user.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    with progress.stage("reading the motion data", None):
        motions = {i: recording.motion() for i, recording in enumerate(recordings)}
    return completed_motions(recordings, config, motions, progress)


def completed_motions(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
) -> tuple[dict[int, MotionData], Config, tuple[str, ...]]:
    """`motions_of` from motion data that have been read."""
    motions, used, placements = with_odometry(recordings, config, motions, progress)
    odometry = [m.poses for m in motions.values() if isinstance(m.poses, OdometryPoses)]
    if not odometry:
        return motions, config, ()
    notes = [odometry_sentence(o.lidar, o.statement, config) for o in odometry[:1] if o.statement]
    notes += map(placement_sentence, placements)
    # Clouds of a target have no pose that is known without them.
    return motions, used.model_copy(update={"target": False}), tuple(notes)


def prepare(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
    refused: TargetError | None = None,
) -> Prepared:
    """Smooths the trajectories and finds target, ground and structure along them.

    Args:
        recordings: opened drives.
        config: topics, noise, target, ground.
        motions: motion data of each drive, by its index.
        progress: reports every stage.
        refused: why the target that the search would find is not used; None: it is.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    check_clouds(recordings, config)
    as_given = recordings, config
    recordings = [CountedRecording(of) for of in as_used(recordings, config, motions)]
    recordings, pauses = _with_poses(recordings, config, motions)
    raw = raw_findings(motions, config)
    raise_fatal(raw)
    rough, findings, search, placements = _searched(
        recordings, config, motions, raw, progress, refused
    )
    config, misplaced, observations, no_target, wrong = search
    every_patch = _patches(recordings, rough, config, progress)
    deskewed, said = _deskewed(every_patch, rough, config, motions)
    if deskewed:
        del every_patch, rough, recordings, search, observations
        given, asked = as_given
        prepared = prepare(given, _with_deskewed(asked, deskewed), motions, progress, refused)
        return replace(prepared, warnings=(*prepared.warnings, said))
    patches, of_body = _without_own_body(every_patch, rough, config)
    del every_patch
    observations = tuple(with_range_noise(o, patches) for o in observations)
    patches = tuple(without_targets(p, observations, rough[p.drive], config) for p in patches)
    kept = kept_stamps(patches, usable(observations))
    if no_target is not None and not kept:
        raise no_target
    with progress.stage("smoothing the trajectory at the scans", None):
        stamps = _stamps_seen(len(recordings), observations, patches)
        trajectories = smooth_trajectories(
            recordings, config, stamps, motions, rough, by_walls=True
        )
    del rough  # a graph of its own, which nobody asks any more
    grounds: Sequence[GroundObservation] = ()
    ground_warnings: Sequence[str] = ()
    others = {patch.lidars[i] for patch in patches for i in np.unique(patch.scan_lidar)}
    # Without motion data the ground is in the structure, and in how the vehicle stands on it.
    if not any(isinstance(motion.poses, OdometryPoses) for motion in motions.values()):
        # Points are moved with the rates of the trajectory whose poses the graph has.
        grounds, ground_warnings = measure_grounds(
            recordings, trajectories, observations, config, progress, others, kept
        )
    config, on_grass = _on_rough_ground(config, recordings, grounds, patches, trajectories)
    warnings = [*pauses, *(w for r in recordings for w in r.warnings())]
    warnings += map(placement_sentence, placements)
    warnings += [w for t in trajectories for w in t.warnings]
    warnings += [w for o in observations for w in o.warnings]
    if no_target is not None:
        warnings.append(no_target_sentence(no_target.what))
    warnings += of_body
    warnings += on_grass
    return Prepared(
        tuple(trajectories),
        tuple(observations),
        tuple(grounds),
        findings,
        (*warnings, *ground_warnings, *warnings_of(findings)),
        config,
        displaced(observations, trajectories, config),
        patches,
        no_target,
        wrong,
        misplaced,
    )


def as_used(
    recordings: Sequence[Recording], config: Config, motions: Mapping[int, MotionData]
) -> list[Recording]:
    """The recordings as all stages see them.

    Clouds that were deskewed before they were recorded have no times, and clouds that share a pose
    have one stamp. `motions` by the recording's index.
    """
    return [
        sharing_poses(recording, motions[index], config)
        for index, recording in enumerate(without_times(recordings, config))
    ]


def _with_poses(
    recordings: Sequence[Recording], config: Config, motions: Mapping[int, MotionData]
) -> tuple[list[Recording], list[str]]:
    """Without the scans for which given poses pause; and a warning for each drive with such."""
    out, lines = [], []
    for index, recording in enumerate(recordings):
        poses, line = motions[index].poses, ""
        if poses is not None and takes_given_poses(motions[index], config):
            recording, line = without_pauses(recording, poses.stamps_ns)
        out.append(recording)
        lines += [line] if line else []
    return out, lines


Search = tuple[
    Config, tuple[str, ...], tuple[TargetObservation, ...], TargetError | None, tuple[str, ...]
]
"""The config with the guesses that the search had to replace; how they contradict what the LiDARs
see, a sentence each; the targets' clouds; why there are none, if structure may replace them; and
mistakes of the config that explain what LiDARs do not see, a sentence each."""


def _searched(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    raw: tuple[Finding, ...],
    progress: Progress,
    refused: TargetError | None = None,
) -> tuple[Sequence[VehicleTrajectory], tuple[Finding, ...], Search, tuple[Placement, ...]]:
    """The rough trajectories, all findings (`raw` first), the targets, and found mountings.

    Raises:
        ConfigError: a LiDAR has no guess, and the drive does not show its mounting.
        TrajectoryError: the motion data are unusable.
        TargetError: no target was found, and the config does without structure or gives a region.
    """
    rough: Sequence[VehicleTrajectory] = ()
    findings = raw
    placements: tuple[Placement, ...] = ()
    wrong: tuple[Doubt, ...] = ()
    try:
        with progress.stage("smoothing the trajectory", None):
            rough = smooth_trajectories(
                recordings, config, [[] for _ in recordings], motions, by_walls=True
            )
        config, placements = place_lidars(recordings, rough, config, progress)
        findings += smoothed_findings(recordings, rough, motions, config, progress)
        if refused is not None:
            return rough, findings, (config, (), (), refused, ()), placements
        found = targets_of(recordings, rough, config, progress)
    except (TrajectoryError, TargetError) as error:
        wrong = mistakes(recordings, rough, motions, config, progress, raw)
        said = tuple(mistake_sentence(doubt, config) for doubt in wrong)
        caused: CalivError = error
        if wrong:
            caused = type(error)(_what(error), " ".join(said))
        else:
            caused = _with_cause(error, rough, motions, config, (findings, raw))
        if caused is error and isinstance(error, TargetError) and config.target:
            elsewhere = region_sentence(placements)
            caused = TargetError(error.what, elsewhere) if elsewhere else error
        if not (isinstance(caused, TargetError) and config.target is None and _uses(config)):
            raise caused from error
        return rough, findings, (config, (), (), caused, said), placements
    near, misplaced, observations = found
    if observations:
        wrong = mistakes(recordings, rough, motions, config, progress, raw, observations)
    if wrong:
        # The search takes a mistake for guesses that are off.
        misplaced, observations = (), without_remedies(observations, wrong)
    said = tuple(mistake_sentence(doubt, config) for doubt in wrong)
    return rough, findings, (near, misplaced, observations, None, said), placements


def _what(error: CalivError) -> str:
    """A message without its remedy."""
    return error.what if isinstance(error, TargetError) else str(error)


def _uses(config: Config) -> bool:
    """Whether structure is used; the paper's procedure does without."""
    return config.structure.use and config.solve.mode != "staged"


def _patches(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[DrivePatches, ...]:
    """The patches of every drive, if structure is used."""
    if not _uses(config):
        return ()
    return read_patches(recordings, trajectories, config, progress, keep_level=True)


def _deskewed(
    patches: Sequence[DrivePatches],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    motions: Mapping[int, MotionData],
) -> tuple[frozenset[str], str]:
    """LiDARs whose clouds were deskewed before they were recorded, and a warning.

    Those that do not tell are taken as the others, if none of these is as it was measured. None by
    an odometry of LiDARs, which was made with the times.
    """
    asked = {name for name, lidar in config.lidars.items() if lidar.deskewed == "auto"}
    if not asked or any(isinstance(motion.poses, OdometryPoses) for motion in motions.values()):
        return frozenset(), ""
    guesses = {name: lidar.guess() for name, lidar in config.lidars.items()}
    left = motion_left(patches, trajectories, guesses)
    told = {name: of for name, of in left.items() if of.deskewed and name in asked}
    if not told:
        return frozenset(), ""
    # A LiDAR without times has none to leave out.
    swept = {of.lidars[k] for of in patches for k in np.unique(of.scan_lidar[of.swept_scans])}
    measured = any(of.measured for of in left.values())
    measured |= any(lidar.deskewed is False for lidar in config.lidars.values())
    silent = (
        []
        if measured
        else [name for name in config.lidars if name in (asked & swept) - left.keys()]
    )
    figures = {name: (of.share, of.sigma, of.scans) for name, of in told.items()}
    return frozenset([*told, *silent]), deskewed_sentence(figures, silent)


def _with_deskewed(config: Config, deskewed: frozenset[str]) -> Config:
    """The config that says so of some LiDARs."""
    lidars = {
        name: lidar.model_copy(update={"deskewed": True}) if name in deskewed else lidar
        for name, lidar in config.lidars.items()
    }
    return config.model_copy(update={"lidars": lidars})


def _without_own_body(
    patches: Sequence[DrivePatches], trajectories: Sequence[VehicleTrajectory], config: Config
) -> tuple[tuple[DrivePatches, ...], tuple[str, ...]]:
    """The patches that are not on the vehicle; warnings of LiDARs that see it, one of each."""
    out, seen = [], dict[str, tuple[float, float]]()
    for of in patches:
        rest, found = without_own_body(of, trajectories[of.drive], config)
        out.append(rest)
        for body in found:
            share, reach_m = seen.get(body.lidar, (0.0, 0.0))
            seen[body.lidar] = max(share, body.share), max(reach_m, body.reach_m)
    return tuple(out), tuple(own_body_sentence(name, *found) for name, found in seen.items())


ROUGH_M = 0.008
"""Scatter of the ground from which it is no road. LiDARs see roads scatter by 1 to 5 mm."""

TILT_PER_M = 0.04
"""Tilt in which a LiDAR sees all such ground, rad, 1 sigma, per metre of its scatter: what it sees
of blades changes with their length from place to place, and with the angle of its beams. Of two
LiDARs and two drives on a meadow that scatters by 16 mm, roll and pitch were 0.6 mrad off each."""

HEIGHT_SHARE = 0.2
"""How much higher or lower a LiDAR sees all such ground than others do, 1 sigma, over its scatter:
more of the flat beams end at the tips. 3 mm of 17 (drives in `structure/README.md`, section 8)."""

LIFT = 1.5
"""Height of what LiDARs see of grass above the soil, over its scatter: blades have all lengths, and
what they see of them begins at the soil."""


def _on_rough_ground(
    config: Config,
    recordings: Sequence[Recording],
    grounds: Sequence[GroundObservation],
    patches: Sequence[DrivePatches],
    trajectories: Sequence[VehicleTrajectory],
) -> tuple[Config, tuple[str, ...]]:
    """The config with larger sigmas of the ground where it is grass or gravel; warnings.

    Wheels stand lower there than what LiDARs see of the ground, all along the drive, and each LiDAR
    sees it in a frame of its own. By its planes; where there are none, by its patches, of which
    grass leaves the smoothest or none.
    """
    ground, noise = config.ground, config.noise
    if not ground.use:
        return config, ()
    guesses = {name: lidar.guess() for name, lidar in config.lidars.items()}
    rough: dict[str, float] = {}
    by_drive = {of.drive: of for of in patches}
    for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
        rough_m = roughness_m(grounds, drive)
        if rough_m is None and drive in by_drive:
            rough_m = ground_roughness_m(by_drive[drive], trajectory, guesses)
        if rough_m is not None and rough_m > ROUGH_M:
            rough[recording.name] = max(rough_m, rough.get(recording.name, 0.0))
    if not rough:
        return config, ()
    most_m = max(rough.values())
    stated_m, used_m = None, ground.sigma
    if ground.vehicle_height is not None:
        stated_m, used_m = ground.sigma, math.hypot(ground.sigma, LIFT * most_m)
    tilt_deg = noise.lidar_ground_tilt_deg or math.degrees(TILT_PER_M * most_m)
    height_m = noise.lidar_ground_height_m or HEIGHT_SHARE * most_m
    known = {
        "ground": ground.model_copy(update={"sigma": used_m}),
        "noise": noise.model_copy(
            update={"lidar_ground_tilt_deg": tilt_deg, "lidar_ground_height_m": height_m}
        ),
    }
    seen = (math.radians(tilt_deg), height_m)
    said = rough_ground_sentence(rough, stated_m, used_m, seen)
    return config.model_copy(update=known), (said,)


def _with_cause(
    error: TrajectoryError | TargetError,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    findings: tuple[Sequence[Finding], Sequence[Finding]],
) -> CalivError:
    """An error with what most likely caused it; `findings` are all so far, and the raw ones."""
    found, raw = findings
    causes = (*found, *heading_findings(trajectories, motions, config, raw))
    if isinstance(error, TargetError) and not causes:
        stood = with_standing(error, trajectories)
        if stood is not None:
            return stood
        said = _doubts_about_motion(trajectories, motions, config)
        if said:
            return TargetError(error.what, said)
    return with_cause(error, causes)


def targets_of(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[Config, tuple[str, ...], tuple[TargetObservation, ...]]:
    """The config with the guesses that the search had to replace; sentences; the targets' clouds.

    The sentences say how these guesses contradict what the LiDARs see.
    """
    if config.target is False:
        return config, (), ()
    searched = (
        find_target(recordings, trajectories, config, progress) if config.target is None else []
    )
    config, misplaced = realigned(config, searched, are_given(trajectories))
    observations = extract_targets(
        recordings, trajectories, config, progress, choose_static, searched
    )
    return config, misplaced, observations


def _doubts_about_motion(
    trajectories: Sequence[VehicleTrajectory], motions: Mapping[int, MotionData], config: Config
) -> str:
    """What is most likely wrong by the motion data alone, for the end of a message; or nothing.

    A wrong lever arm lets a target wander, and none is found.
    """
    try:
        return motion_sentence(motion_suspects(trajectories, motions, config))
    except TrajectoryError:
        return ""


def _stamps_seen(
    drives: int,
    observations: Sequence[TargetObservation],
    patches: Sequence[DrivePatches],
) -> list[list[int]]:
    """Per drive the stamps of the scans that see a target, and of those with patches."""
    seen = {(cloud.drive, cloud.stamp_ns) for o in observations for cloud in o.clouds}
    seen |= {(of.drive, stamp) for of in patches for stamp in of.stamps_ns.tolist()}
    return [sorted(stamp for d, stamp in seen if d == drive) for drive in range(drives)]
