"""The solve of structure with known truth, and what it determines."""

import itertools
import weakref
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.geometry.se3 import joint_right_to_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Array, StructureTerm
from caliv_graph.structure import problem as problems
from caliv_graph.structure import solve as solving
from caliv_graph.structure import term as terms
from caliv_graph.structure import thickness
from caliv_graph.structure.beams import beam_nodes
from caliv_graph.structure.elimination import factor_of
from caliv_graph.structure.jitter import Clocks
from caliv_graph.structure.noise import ONE_VIEW_M, range_sigmas
from caliv_graph.structure.problem import Problem, geometry_at, part_of
from caliv_graph.structure.residuals import Geometry
from caliv_graph.structure.solve import Solved, measured_slip, solve_structure
from caliv_graph.structure.standing import Standing
from caliv_graph.structure.system import System, system_of
from caliv_graph.structure.term import FRAME_ARM_M, FRAME_PART, term_of
from caliv_graph.structure.thickness import thickness_at_guesses
from caliv_graph.structure.thinning import with_scans
from caliv_graph.structure.views import Views
from tests.structure.yards import (
    STEP_NS,
    TRUE,
    Noise,
    Slip,
    Wall,
    draw_patches,
    draw_prior,
    figure_eight,
    poses,
    yard,
)

NO_GROUND = Standing(None, 0.005, None, 0.005, 1e-3)
NOISE = Noise()
GUESS_SIGMAS = np.array([0.03] * 3 + [0.06] * 3)


def problem_of(
    walls: list[Wall],
    path: tuple[Array, Array],
    seed: int,
    noise: Noise = NOISE,
    jitter_s: float = 0.0,
    extrinsics: dict[str, gtsam.Pose3] = TRUE,
    clock_s: float = 0.0,
    slip: Slip | None = None,
) -> Problem:
    """A drive; `jitter_s` is 1 sigma of the time at which a scan is taken after its stamp.

    All stamps are late by `clock_s`; a mount may slip.
    """
    rng = np.random.default_rng(seed)
    true_poses = poses(*path)
    twists = _twists(true_poses)
    late_s = jitter_s * np.random.default_rng([seed, 1]).standard_normal(len(twists)) - clock_s
    taken = [T.retract(d) for T, d in zip(true_poses, late_s[:, None] * twists, strict=True)]
    patches = draw_patches(walls, taken, rng, noise, extrinsics, patch_m=1.0, slip=slip)
    off = [rng.uniform(-0.005, 0.005, 6) for _ in extrinsics]
    guesses = tuple(T.retract(d) for T, d in zip(extrinsics.values(), off, strict=True))
    return Problem(
        patches=patches,
        prior=draw_prior(true_poses, rng),
        pose_of_scan=patches.stamps_ns // STEP_NS,
        relative=np.tile(np.eye(4), (len(patches.scan), 1, 1)),
        twists=twists,
        offsets=(),
        guesses=guesses,
        held_at=guesses,
        held_information=np.diag(np.tile(GUESS_SIGMAS**-2.0, 2)),
        range_sigma_m=0.01,
        standing=NO_GROUND,
        views=Views.numbered(np.arange(len(patches.stamps_ns))),
    )


def _twists(T_map_vehicle: Sequence[gtsam.Pose3]) -> Array:
    """(m, 6) velocity at each pose."""
    steps = [gtsam.Pose3.Logmap(a.between(b)) for a, b in itertools.pairwise(T_map_vehicle)]
    return np.array([*steps, steps[-1]]) / (STEP_NS * 1e-9)


def solve(problem: Problem) -> Solved:
    names = problem.patches.lidars
    found = solve_structure(problem, dict(zip(names, problem.guesses, strict=True)))
    assert found is not None
    return found


def information_of(term: StructureTerm, motion: Array) -> Array:
    """(12, 12) of the extrinsics, vehicle axes, poses eliminated under the motion data."""
    n = len(motion)
    H = term.information.copy()
    H[:n, :n] += motion
    D = H[n:, n:] - H[n:, :n] @ np.linalg.solve(H[:n, :n], H[:n, n:])
    inverse = np.linalg.inv(joint_right_to_vehicle_axes(term.T_vehicle_lidar.values()))
    return np.asarray(inverse.T @ D @ inverse)


def between(e: Array) -> Array:
    """(6,) error of S2S, vehicle axes, from the errors (12,) of front and rear."""
    d = TRUE["front"].translation() - TRUE["rear"].translation()
    turn, shift = e[:3] - e[6:9], e[3:6] - e[9:]
    return np.concatenate([turn, shift - np.cross(e[6:9], d)])


def motion_of(found: Solved) -> Array:
    """Information of the motion data at the estimate."""
    return found.problem.prior.at(found.state.moved)[0]


@cache
def in_yard() -> Solved:
    """The drive that other files look at, too."""
    return solve(problem_of(yard(), figure_eight(24), 1))


@pytest.fixture(scope="module")
def solved() -> Solved:
    return in_yard()


@pytest.fixture(scope="module")
def late() -> Solved:
    """The same drive; stamps are late, and taken as they are."""
    return solve(problem_of(yard(), figure_eight(24), 1, clock_s=0.02))


def test_a_mount_that_slips_is_found(solved: Solved) -> None:
    """The right one, its size by a solve in which it is two LiDARs; none where none slips."""
    for name in ("front", "rear"):
        by = np.array([0.002, -0.003, 0.015, 0.01, -0.02, 0.0])
        own = list(TRUE).index(name)
        problem = problem_of(yard(), figure_eight(18), 1, slip=Slip((own,), 9, by))
        found = solve(problem)
        assert found.slips is not None
        slip = found.slips.slip()
        assert (slip.lidars, slip.others) == ((name,), ())
        assert slip.since_s == pytest.approx(9 * STEP_NS * 1e-9)
        assert slip.lasts_s == pytest.approx(17 * STEP_NS * 1e-9)
        assert slip.sigmas > 10.0
        start = dict(zip(TRUE, found.state.T_vehicle_lidar, strict=True))
        measured = measured_slip(problem, start, slip)
        R = TRUE[name].rotation().matrix()
        assert measured.change[:3] == pytest.approx(R @ by[:3], abs=1e-3)
        assert measured.change[3:5] == pytest.approx((R @ by[3:])[:2], abs=0.01)
    assert solved.slips is not None
    assert solved.slips.slip().sigmas < 3.0


def test_late_stamps_are_no_slip(late: Solved) -> None:
    assert late.slips is not None
    assert late.slips.slip().sigmas < 4.0


def test_a_guess_that_is_off_is_no_slip_of_a_lidar_that_joins_halfway() -> None:
    """What holds the extrinsic before it sees anything is the guess, 0.2 rad off at 0.03."""
    whole = problem_of(yard(), figure_eight(24), 1)
    joined = (whole.patches.scan_lidar == 0) | (whole.patches.stamps_ns > 12 * STEP_NS)
    problem = with_scans(whole, joined)[0]
    off = problem.held_at[1].retract(np.array([0.0, 0.0, 0.2, 0.3, 0.0, 0.0]))
    found = solve(replace(problem, held_at=(problem.held_at[0], off)))
    assert found.slips is not None
    assert found.slips.slip().sigmas < 3.0


def test_a_late_clock_shows_while_it_is_held(solved: Solved, late: Solved) -> None:
    """In curves to both sides no extrinsic makes up for it."""
    assert set(late.clocks.late) == set(solved.clocks.late) == {"front", "rear"}
    for name, (value_s, sigma_s) in late.clocks.late.items():
        # One linear step from the wrong extrinsics, on poses 2 m apart.
        assert value_s == pytest.approx(0.02, rel=0.25)
        assert value_s > 20.0 * sigma_s
        right_s, sigma_s = solved.clocks.late[name]
        assert abs(right_s) < 4.0 * sigma_s
    apart_s, sigma_s = solved.clocks.apart["front", "rear"]
    assert abs(apart_s) < 4.0 * sigma_s
    # Nothing is held where the offsets are free.
    free = replace(problem_of(yard(), figure_eight(10), 1, clock_s=0.02), offsets=(0, 1))
    accelerations = np.zeros_like(free.twists)
    assert solve(replace(free, accelerations=accelerations)).clocks == Clocks()


def test_a_yard_determines_all_but_the_height(solved: Solved) -> None:
    error = np.concatenate(
        [
            vehicle_axes_difference(T, TRUE[name])
            for T, name in zip(solved.state.T_vehicle_lidar, TRUE, strict=True)
        ]
    )
    motion = motion_of(solved)
    term = term_of(solved, np.arange(24))
    cov = np.linalg.inv(information_of(term, motion) + np.diag(np.tile(GUESS_SIGMAS**-2.0, 2)))
    axes = np.array([between(column) for column in np.eye(12)]).T
    cov_between = axes @ cov @ axes.T
    found = between(error)
    some = [0, 1, 2, 3, 4]
    nees = found[some] @ np.linalg.solve(cov_between[np.ix_(some, some)], found[some])
    assert nees < 20.5  # 5 degrees of freedom, one of 1000
    sigma = np.sqrt(np.diag(cov_between))
    assert sigma[:3].max() < 1e-3
    assert sigma[3:5].max() < 2e-3
    assert sigma[5] > 0.01  # walls alone do not tell the height


def test_the_vehicle_stands_on_strips_as_they_are_now(solved: Solved) -> None:
    # One that hardly any sighting holds may have turned upright since it was found to be level.
    state = solved.state
    pose = int(solved.problem.pose_of_scan[0])
    centres, normals = state.centres_map.copy(), state.normals_map.copy()
    centres[0] = state.t_map_vehicle[pose] - [0.0, 0.0, 0.5]
    normals[0] = [0.0, 0.0, 1.0]

    def stood_on() -> list[int]:
        now = replace(state, centres_map=centres, normals_map=normals)
        strips: list[int] = replace(solved, state=now).stands().strip.tolist()
        return strips

    assert 0 in stood_on()
    normals[0] = [0.98, 0.1, 0.17]
    assert 0 not in stood_on()


def test_the_noise_of_sightings_is_estimated(solved: Solved) -> None:
    sigma = np.median(solved.nuisances.sighting)
    assert 0.5 * NOISE.sighting_m < sigma < 1.5 * NOISE.sighting_m
    assert range_sigmas(solved.problem.patches, 0.03) == pytest.approx([0.01, 0.01], rel=0.15)


def test_strips_that_lidars_see_tilted_apart_are_seen_apart(solved: Solved) -> None:
    noise, upright = solved.nuisances, ~solved.strips.level
    sigmas = np.log([noise.strip_tilt[upright], noise.strip[upright]])
    assert np.corrcoef(sigmas)[0, 1] > 0.75


def test_the_jitter_of_stamps_is_estimated(solved: Solved) -> None:
    """At 24 m/s a millisecond is 24 mm, and 1.2 mm is less than a sighting's own error."""
    assert solved.nuisances.jitter_s < 5e-5
    jittering = solve(problem_of(yard(), figure_eight(20), 1, jitter_s=1e-3))
    assert jittering.nuisances.jitter_s == pytest.approx(1e-3, rel=0.4)
    assert np.median(jittering.nuisances.sighting) < 1.5 * NOISE.sighting_m


AHEAD = {
    "front": TRUE["front"],
    "left": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.17, 0.5), np.array([1.0, 0.8, 1.9])),
}


def test_scans_from_one_place_say_more_than_one_and_no_more_than_they_know() -> None:
    """Both LiDARs see the same bumps; the noise of their beams averages out.

    Two places tell what is repeated; where there is one alone, millimetres are taken as repeated.
    """
    still = (np.zeros((12, 3)), np.zeros(12))
    problem = problem_of(yard(), still, 4, Noise(sighting_m=0.0, bias_m=0.0), extrinsics=AHEAD)
    of_lidar = problem.patches.scan_lidar
    alone = solve(replace(problem, views=Views.numbered(of_lidar)))
    assert alone.nuisances.repeated == 1.0
    assert alone.nuisances.sighting.min() == alone.nuisances.strip.min() == ONE_VIEW_M
    two_places = Views.numbered(
        2 * of_lidar + (problem.patches.stamps_ns > np.median(problem.patches.stamps_ns))
    )
    found = solve(replace(problem, views=two_places))
    assert found.nuisances.repeated < 0.2
    assert np.median(found.nuisances.sighting) < 1e-3
    assert np.median(found.nuisances.strip) < 3e-3
    names = zip(found.state.T_vehicle_lidar, AHEAD.values(), strict=True)
    error = np.concatenate([vehicle_axes_difference(T, true) for T, true in names])
    H = information_of(term_of(found, np.arange(12)), motion_of(found))
    cov = np.linalg.inv(H + np.diag(np.tile(GUESS_SIGMAS**-2.0, 2)))
    turn = np.hstack([np.eye(3), np.zeros((3, 3)), -np.eye(3), np.zeros((3, 3))])
    cov_turn = turn @ cov @ turn.T
    assert np.sqrt(np.diag(cov_turn)).max() < 2e-3
    assert turn @ error @ np.linalg.solve(cov_turn, turn @ error) < 16.3  # one of 1000


def test_the_term_is_the_marginal_on_fewer_poses_too(solved: Solved) -> None:
    """Extrinsics know the same whichever poses are kept."""
    motion = motion_of(solved)
    cov = np.linalg.inv(motion)
    all_of = information_of(term_of(solved, np.arange(24)), motion)
    few = np.array([2, 9, 20])
    own = (6 * few[:, None] + np.arange(6)).ravel()
    fewer = information_of(term_of(solved, few), np.linalg.inv(cov[np.ix_(own, own)]))
    scale = np.sqrt(np.diag(all_of))
    assert fewer / np.outer(scale, scale) == pytest.approx(
        all_of / np.outer(scale, scale), abs=1e-5
    )


def test_the_frame_of_walls_and_ground_errs(solved: Solved) -> None:
    """The covariance of extrinsics is larger by that of the frames; the estimate stays."""
    tilt_rad = 0.02
    motion = motion_of(solved)
    known: list[Array] = []
    spread: list[Array] = []
    for own_rad, out in ((0.0, known), (tilt_rad, spread)):
        tilts = np.full(len(solved.nuisances.sighting_tilt), own_rad)
        found = replace(solved, nuisances=replace(solved.nuisances, sighting_tilt=tilts))
        term = term_of(found, np.arange(24))
        H = term.information.copy()
        H[: len(motion), : len(motion)] += motion
        H[-12:, -12:] += 1e-6 * np.diag(np.tile(GUESS_SIGMAS**-2.0, 2))  # the height is open
        step = np.asarray(np.linalg.solve(H, term.gradient)[-12:], np.float64)
        out += [information_of(term, motion), step]

    turn_rad = tilt_rad * FRAME_PART
    frames = np.diag(np.tile(np.repeat([turn_rad, turn_rad * FRAME_ARM_M], 3) ** 2, 2))
    scale = np.sqrt(np.outer(np.diag(known[0]), np.diag(known[0])))
    expected = np.linalg.solve(np.eye(12) + known[0] @ frames, known[0])
    assert spread[0] / scale == pytest.approx(expected / scale, abs=1e-6)
    assert spread[0][3, 3] < 0.5 * known[0][3, 3]
    assert spread[1] == pytest.approx(known[1], abs=1e-6)


def test_nothing_shows_the_mean_azimuth_of_a_lidar_without_rows(solved: Solved) -> None:
    """The variance of its turn about its own axis is larger by 0.115 mrad over two, squared."""
    motion = motion_of(solved)
    patches = replace(solved.problem.patches, without_rows=frozenset({1}))
    apart = replace(solved, problem=replace(solved.problem, patches=patches))
    known, less = (information_of(term_of(of, np.arange(24)), motion) for of in (solved, apart))
    loose = 1e-9 * np.diag(np.diag(known))  # the height is open
    before, after = (np.linalg.inv(H + loose) for H in (known, less))
    more = np.sqrt((after - before)[8, 8])
    assert more == pytest.approx(0.5 * 1.15e-4, rel=0.03)
    assert after[2, 2] == pytest.approx(before[2, 2], rel=1e-3)


def test_a_term_says_nothing_against_itself(solved: Solved) -> None:
    information = term_of(solved, np.arange(0, 24, 3)).information
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    assert np.linalg.eigvalsh(information / np.outer(scale, scale)).min() > -1e-6


def test_another_map_gives_the_same_extrinsics() -> None:
    problem = problem_of(yard(), figure_eight(10), 2)
    first = solve(problem)
    turn = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([100.0, -40.0, 7.0]))
    prior = replace(
        problem.prior,
        T_map_vehicle=tuple(turn.compose(T) for T in problem.prior.T_map_vehicle),
    )
    second = solve(replace(problem, prior=prior))
    for a, b in zip(first.state.T_vehicle_lidar, second.state.T_vehicle_lidar, strict=True):
        # Cells of the map fall elsewhere, so that the strips are others.
        assert np.abs(vehicle_axes_difference(a, b))[[0, 1, 2, 3, 4]].max() < 2e-3


def _straight(m: int) -> tuple[Array, Array]:
    return np.stack([np.linspace(-12.0, 12.0, m), np.zeros(m), np.zeros(m)], axis=1), np.zeros(m)


PARALLEL = [Wall((0.0, 7.0), -np.pi / 2, 30.0), Wall((0.0, -7.0), np.pi / 2, 30.0)]


def test_between_parallel_walls_what_lies_along_them_is_unknown() -> None:
    """Straight ahead between two fronts: no wall says where along the street a LiDAR is."""
    found = solve(problem_of(PARALLEL, _straight(12), 3))
    D = information_of(term_of(found, np.arange(12)), found.problem.prior.information)
    along, across = np.zeros(12), np.zeros(12)
    along[3], across[4] = 1.0, 1.0  # x and y of the front LiDAR alone
    assert along @ D @ along < GUESS_SIGMAS[3] ** -2.0
    assert across @ D @ across > 0.005**-2.0


def test_nothing_to_see_is_said() -> None:
    problem = problem_of(PARALLEL, _straight(24), 3)
    few = part_of(problem, np.arange(len(problem.patches.scan)) < 5)
    assert solve_structure(few, dict(TRUE)) is None


def test_thickness_does_not_depend_on_how_many_sightings_are_taken_at_a_time(
    solved: Solved, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = thickness_at_guesses(solved)
    monkeypatch.setattr(thickness, "TOGETHER", 7)
    assert thickness_at_guesses(solved) == pytest.approx(together, nan_ok=True)


def test_strips_that_are_not_there_at_the_guesses_have_no_thickness_before(
    solved: Solved,
) -> None:
    """At guesses that face away, no sighting of the solve is one: a run once ended with exit 1."""
    away = gtsam.Pose3(gtsam.Rot3.Yaw(0.5 * np.pi), np.zeros(3))
    guesses = tuple(away.compose(T) for T in solved.problem.guesses)
    none = replace(
        solved,
        problem=replace(solved.problem, guesses=guesses),
        sightings=solved.sightings.only(np.zeros(0, dtype=np.int64)),
        weights=np.zeros(0),
    )
    assert np.isnan(thickness_at_guesses(none)).all()
    assert not np.isnan(thickness_at_guesses(solved)).all()


@pytest.mark.parametrize("jitter_s", [0.0, 2e-3])
def test_one_estimate_at_a_time_has_residuals_and_none_while_surfaces_are_eliminated(
    monkeypatch: pytest.MonkeyPatch, jitter_s: float
) -> None:
    """Of a long drive residuals are as large as a system: peak memory is of one or the other."""
    made: list[weakref.ref[Geometry]] = []
    systems: list[weakref.ref[System]] = []

    def geometry(*args: Any) -> Geometry:
        assert not any(of() for of in made)
        out = geometry_at(*args)
        # No second copy of a half of the derivatives.
        assert out.beams is None or np.shares_memory(out.beams.by, out.by)
        made.append(weakref.ref(out))
        return out

    def system(*args: Any) -> System:
        assert not any(of() for of in made)
        assert not any(of() for of in systems)
        out = system_of(*args)
        systems.append(weakref.ref(out))
        return out

    problem = problem_of(yard(), figure_eight(8), 1, jitter_s=jitter_s)
    problem = replace(problem, beam_nodes=beam_nodes(problem.patches))
    monkeypatch.setattr(solving, "geometry_at", geometry)
    monkeypatch.setattr(solving, "system_of", system)
    found = solve(problem)
    assert (found.nuisances.jitter_s > 0.0) == (jitter_s > 0.0)
    assert not any(of() for of in made)
    assert found.layout.beams
    assert len(made) >= len(systems) > 8


@pytest.mark.parametrize(
    ("moved_m", "steps"),
    [
        ([0.5, 0.02, 0.4], 2),
        ([0.01, 0.4, 0.02, 0.4], 3),
        ([0.4] * 9, solving.LAST_STEPS),
    ],
)
def test_no_strips_are_cut_in_the_middle_of_a_wild_step(
    monkeypatch: pytest.MonkeyPatch, solved: Solved, moved_m: list[float], steps: int
) -> None:
    left = list(moved_m)
    monkeypatch.setattr(solving, "_step", lambda *_: (1.0, left.pop(0)))
    found = solving._settled(solving.without_residuals(solved), 2, tame_m=0.03)
    assert len(moved_m) - len(left) == steps
    assert not found.converged


def test_rounds_go_on_while_steps_are_wild_in_their_gates(monkeypatch: pytest.MonkeyPatch) -> None:
    settled, tame_m = solving._settled, list[float]()

    def noted(*args: Any, **named: Any) -> solving.Sighted:
        tame_m.append(named.get("tame_m", np.inf))
        return settled(*args, **named)

    monkeypatch.setattr(solving, "_settled", noted)
    solve(problem_of(yard(), figure_eight(8), 1))

    assert tame_m[:5] == pytest.approx([0.15, 0.075, 0.04, 0.03, 0.03])


def test_a_step_says_by_how_much_it_moves_patches(solved: Solved) -> None:
    """10 mrad at the median range of 10 to 20 m, back to where the LiDAR was."""
    found, turned = solving.without_residuals(solved), gtsam.Pose3(gtsam.Rot3.Rz(0.01), [0, 0, 0])
    at = found.state.T_vehicle_lidar
    state = replace(found.state, T_vehicle_lidar=(at[0], at[1].compose(turned)))
    held = [solving.with_residuals(replace(found, state=state))]
    sigmas, moved_m = solving._step(held, [], tilts=True)
    assert 0.07 < moved_m < 0.25
    assert sigmas > 10.0


def test_residuals_of_some_sightings_at_a_time_are_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = problem_of(yard(), figure_eight(6), 1)
    problem = replace(problem, beam_nodes=beam_nodes(problem.patches))
    found = solve(problem)
    of = found.problem, found.state, found.sightings, found.layout
    whole = geometry_at(*of)
    monkeypatch.setattr(problems, "TOGETHER", 7)
    parts = geometry_at(*of)
    assert parts.beams is not None
    assert whole.beams is not None
    assert np.shares_memory(parts.beams.by, parts.by)
    for name in ("plain", "placed", "by", "columns", "normals_lidar"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    for name in ("by", "column", "turning"):
        np.testing.assert_array_equal(getattr(parts.beams, name), getattr(whole.beams, name))


def test_a_term_lets_go_of_the_solve_before_it_eliminates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What it eliminates is as large as the system."""
    handed = [solve(problem_of(yard(), figure_eight(12), 1))]
    left = weakref.ref(handed[0]), weakref.ref(handed[0].system.H)
    alive: list[bool] = []

    def factor(H: Array, overwrite: bool = False) -> tuple[Array, Array]:
        alive.append(any(of() is not None for of in left))
        return factor_of(H, overwrite)

    monkeypatch.setattr(terms, "factor_of", factor)
    term_of(handed.pop(), np.arange(12))
    assert alive
    assert not any(alive)
