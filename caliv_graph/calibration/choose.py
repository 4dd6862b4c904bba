"""Which of several candidates is the target: the one whose clouds agree on one place of the map.

The search (`targets.search`) proposes by size and view. Here some clouds of every candidate are
registered to each other, freely, which yields the object's centre in each cloud whatever side of it
is visible; and one place, the guesses with their sigmas, must explain all centres
(`targets.search.place`). What walks or is carried does not have one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.errors import RegistrationError, TargetError
from caliv_graph.geometry.se3 import right_to_vehicle_axes, unstack, vehicle_axes_difference
from caliv_graph.products import Array, LidarResult, Surface, TargetObservation
from caliv_graph.readers.pose_frame import poses_source
from caliv_graph.registration.register import JointRegistration, register_jointly
from caliv_graph.targets.cloud.choice import Choice, TriedCandidate
from caliv_graph.targets.cloud.scans import thinned
from caliv_graph.targets.search.place import WIDE_SIGMAS, Place, Sightings, fit_place
from caliv_graph.trajectory.select import VehicleTrajectory, are_given, twists_at
from caliv_graph.uncertainty.consistency import against_guesses, is_scattered, together
from caliv_graph.uncertainty.observability import UNDETERMINED_RATIO
from caliv_graph.wording.contradictions import PosesGiven, contradiction_sentence

CLOUDS = 16
"""Clouds of a LiDAR that decide: evenly spread over the views."""

POINTS = 100
COMPONENTS = 100
ITERATIONS = 25
"""Size of the registration that decides: centimetres are enough."""

TOLERANCE = (5e-3, 3e-3)
"""Median step of a cloud, rad and m, at which it ends. Clouds of so few points never come to rest
to a millimetre."""

AGREE_M = 0.05
"""Scatter of the centres that poses and registrations explain: a candidate with less is static."""

SAME_OBJECT_M = 0.4
"""Candidates whose clouds are at places nearer than this to each other are one object: the guesses
leave half a metre between what the search proposes and what is extracted there."""

MOVES_M = 0.15
"""Scatter above which an object moves, unless late stamps or a wrong guess explain it."""

EXPLAINS = 1.0 / 3.0
"""Factor on the scatter below which late stamps or another guess explain it: poses that drift do
not look like either."""

FEWER = 1.3
"""The stamps of one LiDAR explain the scatter as well as those of all if it is at most this many
times as large."""

LATE_S = 0.02
"""Smallest lateness that is named: at 2 m/s it is 4 cm, which poses explain too."""

AGREE_RATIO = 3.0
"""Poses that are worse displace all candidates: one is static as well if it scatters by at most
this many times as much as the one that scatters least."""


@dataclass(frozen=True)
class Agreement:
    """How well the clouds of a candidate agree.

    Attributes:
        scatter_m: of its centre in the map; infinite where there is nothing to compare.
        place: where it stands.
        sightings: the centres.
        surface: whether its clouds show one.
    """

    scatter_m: float
    place: Place | None = None
    sightings: Sightings | None = None
    surface: Surface | None = None

    @property
    def foliage(self) -> bool:
        """Whether its clouds show no surface."""
        return self.surface is not None and is_scattered(self.surface)


def choose_static(
    candidates: Sequence[TriedCandidate], trajectory: VehicleTrajectory, config: Config
) -> Choice:
    """The candidate that is static, shows a surface, and that most LiDARs see best; with reasons.

    One candidate without a doubt is not tried: there is nothing to choose.

    Raises:
        TargetError: all move.
    """
    if len(candidates) == 1 and not candidates[0].found.doubtful:
        return Choice(0)
    found = [agreement(candidate, trajectory, config) for candidate in candidates]
    scatter = [each.scatter_m for each in found]
    limit = max(AGREE_M, AGREE_RATIO * min(scatter))

    def rank(i: int) -> tuple[bool, bool, int, bool, float]:
        of = candidates[i].found
        static = scatter[i] <= limit and math.isfinite(scatter[i])
        solid = not found[i].foliage
        return static, solid, len(candidates[i].lidars), not of.doubtful, of.score

    apart = _different(candidates, found)
    best = max(apart, key=rank)
    others = [i for i in apart if i != best]
    same = [i for i in others if rank(i)[0] and rank(i)[1] == rank(best)[1]]
    leaves = [i for i in others if found[i].foliage and not found[best].foliage]
    worse = [i for i in others if math.isfinite(scatter[i]) and i not in [*same, *leaves]]
    of = candidates[best].found
    if of.doubtful and scatter[best] > MOVES_M and cause_of(found[best], config) is None:
        raise TargetError(*_why_none_stands(candidates, scatter))
    reasons = []
    if same:
        listed = ", ".join(f"{candidates[i].found} (to {scatter[i]:.2f} m)" for i in same)
        reasons.append(
            f"{of.extent_m:.1f} m wide, {of.height_m:.1f} m high; its clouds agree on one place "
            f"to {scatter[best]:.2f} m. Other static objects fit too: {listed}. Give a target "
            "region to choose"
        )
    if worse:
        listed = ", ".join(f"{candidates[i].found} (to {scatter[i]:.2f} m)" for i in worse)
        reasons.append(
            f"chosen because its clouds agree on one place of the map to {scatter[best]:.2f} m; "
            f"those of other objects agree less: {listed}"
        )
    if leaves:
        listed = ", ".join(str(candidates[i].found) for i in leaves)
        reasons.append(f"chosen because others show no surface, as bushes do: {listed}")
    return Choice(best, tuple(reasons))


def displaced(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
) -> tuple[str, ...]:
    """Late stamps and guesses far off, by targets that are at one place only then; a sentence each.

    The clouds of a circle to the left agree on one place, and those of a circle to the right on
    another: the registration takes both for one target, and no residual of the graph shows it.
    """
    found = _agreements(observations, trajectories, config)
    causes = [(observation.name, cause_of(of, config)) for observation, of in found]
    return tuple(f"{name}: {cause}" for name, cause in causes if cause is not None)


def displaced_or_misguessed(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    given: Collection[str],
) -> tuple[str, ...]:
    """The same, and guesses with which the clouds of an object are not where they are seen.

    Guesses that are off alike bring the clouds of all LiDARs to one place, but not where the poses
    have it: the fit of the place moves them by many of their sigmas. The solve says the same, in
    the same words. `given` are the LiDARs whose guess is tested.
    """
    out: dict[str, None] = {}
    for observation, of in _agreements(observations, trajectories, config):
        cause = cause_of(of, config)
        if cause is not None:
            out[f"{observation.name}: {cause}"] = None
        elif of.place is not None and of.sightings is not None and of.scatter_m <= AGREE_M:
            speed_m_s = float(np.median(np.linalg.norm(of.sightings.twists[:, 3:], axis=1)))
            lidars = {n: _as_result(n, of.place, config) for n in of.place.cov if n in given}
            found = together(tuple(against_guesses(lidars, speed_m_s)), lidars)
            poses = PosesGiven(poses_source(config)) if are_given(trajectories) else None
            out.update((contradiction_sentence(each, given=poses), None) for each in found)
    return tuple(out)


def _as_result(name: str, place: Place, config: Config) -> LidarResult:
    """A LiDAR as the fit of a place has it; an axis is determined if it is known better by it."""
    guess = configured_guess(config, name)
    T, cov = place.T_vehicle_lidar[name], place.cov[name]
    axes = right_to_vehicle_axes(T)
    known = np.sqrt(np.diag(axes @ cov @ axes.T)) <= UNDETERMINED_RATIO * guess.sigmas
    determined = dict(zip(AXES, known.tolist(), strict=True))
    return LidarResult(T, cov, determined, scans_used=0, saw_target=True, guess=guess)


def _agreements(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
) -> list[tuple[TargetObservation, Agreement]]:
    return [
        (seen, _agreement(seen, trajectories[seen.clouds[0].drive], config))
        for seen in observations
        if seen.clouds
    ]


def cause_of(of: Agreement, config: Config) -> str | None:
    """What would bring clouds to one place; None if they are, or if nothing does.

    Late stamps shift an object along the course, by as much as the speed; a guess that is off
    shifts it rigidly in the frame of the vehicle.
    """
    if of.sightings is None or of.scatter_m <= AGREE_M:
        return None
    names = [name for name in config.lidars if name in of.sightings.lidars]
    guesses = _guesses(config)
    enough = EXPLAINS * of.scatter_m
    begin = f"its clouds lie at one place of the map to {of.scatter_m:.2f} m only, but to "
    late = _late_of(of, config)
    if late is not None:
        by = " and ".join(f"those of '{name}' by {s:+.2f} s" for name, s in late.late_s.items())
        return (
            f"{begin}{late.scatter_m:.2f} m if stamps are late: {by}. The displacement grows with "
            "the speed and changes with the turn. Correct the clocks, or set solve.time_offset"
        )
    for name in names:
        T, sigmas = guesses[name]
        far = fit_place(of.sightings, {**guesses, name: (T, np.maximum(sigmas, WIDE_SIGMAS))})
        if far.scatter_m <= enough:
            off = vehicle_axes_difference(far.T_vehicle_lidar[name], T)
            degrees = math.degrees(float(np.linalg.norm(off[:3])))
            return (
                f"{begin}{far.scatter_m:.2f} m if lidars.{name}.initial is off by about "
                f"{degrees:.0f} degrees and {float(np.linalg.norm(off[3:])):.1f} m. Check it"
            )
    return None


def _late(
    seen: Sightings, guesses: Mapping[str, tuple[gtsam.Pose3, Array]], names: Sequence[str]
) -> Place | None:
    """The fewest LiDARs whose late stamps explain the scatter; None if they would not be late."""
    sets = [(name,) for name in names] + ([tuple(names)] if len(names) > 1 else [])
    tried = [fit_place(seen, guesses, late=each) for each in sets]
    least = min(place.scatter_m for place in tried)
    first = next(place for place in tried if place.scatter_m <= FEWER * least)
    return first if max(map(abs, first.late_s.values())) > LATE_S else None


def late_stamps(
    observation: TargetObservation, trajectory: VehicleTrajectory, config: Config
) -> Mapping[str, float]:
    """LiDAR -> lateness (s) of its stamps that brings the clouds to one place of the map.

    Empty: they lie at one place, or no lateness brings them there.
    """
    of = _agreement(observation, trajectory, config)
    late = _late_of(of, config)
    return {} if late is None else late.late_s


def _late_of(of: Agreement, config: Config) -> Place | None:
    """The place with late stamps, if these explain why the clouds are not at one."""
    if of.sightings is None or of.scatter_m <= AGREE_M or config.solve.time_offset:
        return None
    names = [name for name in config.lidars if name in of.sightings.lidars]
    late = _late(of.sightings, _guesses(config), names)
    return late if late is not None and late.scatter_m <= EXPLAINS * of.scatter_m else None


def _why_none_stands(
    candidates: Sequence[TriedCandidate], scatter: Sequence[float]
) -> tuple[str, str]:
    listed = ", ".join(
        f"{candidate.found} (its clouds scatter by {of:.2f} m)"
        for candidate, of in zip(candidates, scatter, strict=True)
        if math.isfinite(of)
    )
    said = f": {listed}" if listed else ""
    return (
        f"target: none found that stands still{said}. Neither late stamps nor a wrong initial "
        "guess of one LiDAR explains it: the objects move, or the poses are wrong",
        "Check the trajectory with 'caliv-graph inspect', and drive past a chair that nobody "
        "stands beside",
    )


def _guesses(config: Config) -> dict[str, tuple[gtsam.Pose3, Array]]:
    """LiDAR -> its guess and the guess's sigmas."""
    of = {name: configured_guess(config, name) for name in config.lidars}
    return {name: (guess.T_vehicle_lidar, guess.sigmas) for name, guess in of.items()}


def _different(candidates: Sequence[TriedCandidate], found: Sequence[Agreement]) -> list[int]:
    """Indices of the candidates without those whose clouds are of the object of another one.

    The region of a candidate, widened by the error of the guesses, may hold its neighbour too.
    """

    def off_m(i: int) -> float:
        place = found[i].place
        if place is None:
            return math.inf
        return float(np.linalg.norm((place.place_map - candidates[i].found.centre_map)[:2]))

    out: list[int] = []
    for i in sorted(range(len(candidates)), key=off_m):
        place = found[i].place
        places = [p.place_map for j in out if (p := found[j].place) is not None]
        if place is None or all(
            float(np.linalg.norm((place.place_map - p)[:2])) > SAME_OBJECT_M for p in places
        ):
            out.append(i)
    return sorted(out)


def agreement(
    candidate: TriedCandidate, trajectory: VehicleTrajectory, config: Config
) -> Agreement:
    """Registers some of a candidate's clouds, and fits one place to its centres."""
    observations = [o for o in candidate.observations if o.clouds]
    if not observations:
        return Agreement(math.inf)
    return _agreement(max(observations, key=lambda o: len(o.clouds)), trajectory, config)


def _agreement(
    observation: TargetObservation, trajectory: VehicleTrajectory, config: Config
) -> Agreement:
    """The same of one placement."""
    clouds = [
        cloud
        for name in config.lidars
        for cloud in thinned(
            [c for c in observation.clouds if c.lidar == name and not c.cut], CLOUDS
        )
    ]
    if len(clouds) < 2:
        return Agreement(math.inf)
    found = _sightings(replace(observation, clouds=tuple(clouds)), trajectory, config)
    if found is None:
        return Agreement(math.inf)
    sightings, surface = found
    place = fit_place(sightings, _guesses(config))
    return Agreement(place.scatter_m, place, sightings, surface)


def _sightings(
    observation: TargetObservation, trajectory: VehicleTrajectory, config: Config
) -> tuple[Sightings, Surface | None] | None:
    """The object's centre in each cloud, and its surface, by a small free registration.

    None if that failed.
    """
    stamps = [cloud.stamp_ns for cloud in observation.clouds]
    R, t = trajectory.poses_at(stamps)
    poses = [
        T.compose(config.lidars[cloud.lidar].guess())
        for T, cloud in zip(unstack(R, t), observation.clouds, strict=True)
    ]
    small = config.registration.model_copy(
        update={"components": 2 * COMPONENTS, "max_points": POINTS}
    )
    try:
        state = JointRegistration(
            observation, config.model_copy(update={"registration": small}), rough=True
        )
        state.tolerance = TOLERANCE
        registered = register_jointly(state, poses, ITERATIONS, other_starts=False)
    except RegistrationError:
        return None
    centres: Array = np.array([T.inverse().translation() for T in registered.T_target_lidar])
    sightings = Sightings(
        lidars=tuple(cloud.lidar for cloud in observation.clouds),
        centres_lidar=centres,
        R_map_vehicle=R,
        t_map_vehicle=t,
        twists=twists_at(trajectory, stamps),
        times_s=1e-9 * (np.array(stamps) - stamps[0]),
    )
    return sightings, registered.surface
