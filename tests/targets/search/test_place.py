"""One place for what is seen again and again: late stamps, wrong guesses and walkers told apart."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.targets.search.place import Sightings, _places, fit_place

CHAIR = np.array([9.0, 1.0, 0.6])
SIGMAS = np.array([0.03] * 3 + [0.058] * 3)
TRUE: Mapping[str, gtsam.Pose3] = {
    "front": gtsam.Pose3(gtsam.Rot3.Ypr(0.0, 0.17, 0.0), np.array([2.0, 0.0, 2.0])),
    "rear": gtsam.Pose3(gtsam.Rot3.Ypr(3.1, 0.17, 0.0), np.array([-0.4, 0.0, 2.0])),
}
SPEED, RATE = 2.0, 0.25
"""m/s and rad/s of a figure-eight."""


def pose(time_s: float) -> gtsam.Pose3:
    """A circle to the left, then one to the right, through the origin."""
    turn_s = 2.0 * np.pi / RATE
    sign = 1.0 if time_s < turn_s else -1.0
    angle = sign * RATE * (time_s % turn_s)
    radius = sign * SPEED / RATE
    at = np.array([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), 0.0])
    return gtsam.Pose3(gtsam.Rot3.Yaw(angle), at)


def sightings(
    late_s: Mapping[str, float] | None = None, velocity: Array | None = None, sigma_m: float = 0.005
) -> Sightings:
    rng = np.random.default_rng(4)
    times = np.linspace(0.5, 49.0, 40)
    lidars, centres, poses, twists = [], [], [], []
    for time_s in times.tolist():
        for name, T in TRUE.items():
            taken = pose(time_s - (late_s or {}).get(name, 0.0)).compose(T)
            at = CHAIR + (0.0 if velocity is None else velocity * (time_s - 25.0))
            lidars.append(name)
            centres.append(taken.transformTo(at) + rng.normal(0.0, sigma_m, 3))
            poses.append(pose(time_s))
            sign = 1.0 if time_s < 2.0 * np.pi / RATE else -1.0
            twists.append([0.0, 0.0, sign * RATE, SPEED, 0.0, 0.0])
    return Sightings(
        tuple(lidars),
        np.array(centres),
        np.array([T.rotation().matrix() for T in poses]),
        np.array([T.translation() for T in poses]),
        np.array(twists),
        np.repeat(times, 2),
    )


def guesses(off: Mapping[str, Array] | None = None) -> dict[str, tuple[gtsam.Pose3, Array]]:
    return {
        name: (T.retract((off or {}).get(name, np.zeros(6))), SIGMAS) for name, T in TRUE.items()
    }


def test_guesses_that_are_off_by_their_sigmas_do_not_scatter() -> None:
    off = {"front": SIGMAS * [1, -1, 1, -1, 1, 1], "rear": SIGMAS * [-1, 1, 1, 1, -1, 1]}
    found = fit_place(sightings(), guesses(off))
    assert found.scatter_m < 0.02
    assert found.place_map[:2] == pytest.approx(CHAIR[:2], abs=0.05)


def test_late_stamps_are_found_and_a_guess_or_a_walk_does_not_explain_them() -> None:
    seen = sightings(late_s={"front": 0.1, "rear": 0.1})
    assert fit_place(seen, guesses()).scatter_m > 0.15
    found = fit_place(seen, guesses(), late=("front", "rear"))
    assert found.scatter_m < 0.02
    assert found.late_s == pytest.approx({"front": 0.1, "rear": 0.1}, abs=0.005)
    assert fit_place(seen, guesses(), moves=True).scatter_m > 0.05


def test_what_walks_has_a_velocity() -> None:
    velocity = np.array([0.02, -0.05, 0.0])
    seen = sightings(velocity=velocity)
    assert fit_place(seen, guesses()).scatter_m > 0.3
    assert fit_place(seen, guesses(), late=("front", "rear")).scatter_m > 0.3
    found = fit_place(seen, guesses(), moves=True)
    assert found.scatter_m < 0.02
    assert found.velocity_map == pytest.approx(velocity, abs=0.002)


def test_what_the_place_tells_of_a_guess_is_right_within_its_covariance() -> None:
    """A figure-eight tells yaw, x and y of a guess; a point tells no roll about the line to it."""
    off = {"front": np.array([0.0, 0.0, 0.2, 0.5, -0.4, 0.0]), "rear": np.zeros(6)}
    found = fit_place(sightings(), guesses(off))
    for name, T in TRUE.items():
        error = T.logmap(found.T_vehicle_lidar[name])
        spread = np.sqrt(np.diag(found.cov[name]))
        assert (spread <= 1.0001 * SIGMAS).all()
        assert (np.abs(error)[[2, 3, 4]] < 3.0 * spread[[2, 3, 4]]).all()


def test_one_cloud_of_something_else_does_not_move_the_place() -> None:
    seen = sightings()
    seen.centres_lidar[7] += [3.0, 2.0, 0.0]
    found = fit_place(seen, guesses())
    assert found.scatter_m < 0.03
    assert found.place_map == pytest.approx(CHAIR, abs=0.05)


def test_jacobians_are_the_derivatives() -> None:
    seen = sightings()
    index = np.array([list(TRUE).index(name) for name in seen.lidars])
    _, J = _places(seen, index, list(TRUE.values()), np.zeros(2))
    for k in range(2):
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-5
            moved = [
                [T.retract(sign * step) if i == k else T for i, T in enumerate(TRUE.values())]
                for sign in (1, -1)
            ]
            up, down = (_places(seen, index, T, np.zeros(2))[0] for T in moved)
            assert J[:, :, 3 + 6 * k + axis] == pytest.approx((up - down) / 2e-5, abs=1e-6)
        late = np.zeros(2)
        late[k] = 1e-3
        shifted = _places(seen, index, list(TRUE.values()), late)[0]
        still = _places(seen, index, list(TRUE.values()), np.zeros(2))[0]
        assert J[:, :, 15 + k] == pytest.approx((shifted - still) / 1e-3, abs=1e-6)
        # The centre as it was when the cloud was taken, not at its stamp.
        mine = np.flatnonzero(index == k)[3]
        T = pose(float(seen.times_s[mine]) - 1e-3).compose(list(TRUE.values())[k])
        assert shifted[mine] == pytest.approx(T.transformFrom(seen.centres_lidar[mine]), abs=1e-5)
