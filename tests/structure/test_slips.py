"""Slips of mounts, from linear systems with known truth."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import scipy.sparse

from caliv_graph.products import Array
from caliv_graph.structure.layout import Layout
from caliv_graph.structure.problem import OFFSET_SIGMA_S
from caliv_graph.structure.rows import Rows
from caliv_graph.structure.slips import (
    MOTION_ALLOWANCE,
    PARTS,
    ToldSlips,
    part_of_scan,
    slip_coupling,
    told_slips,
)
from caliv_graph.uncertainty.consistency import CONTRADICTION_SIGMAS

EACH = 6 * (PARTS - 1)
STAMPS = np.arange(2 * PARTS, dtype=np.int64) * 10**9
"""Two scans in each part."""

T = (
    gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([1.0, 0.5, 2.0])),
    gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, -2.0), np.array([-1.0, 0.0, 1.5])),
)
BY = np.array([0.0, 0.001, 0.017, 0.005, 0.0, 0.0])


def test_parts_have_as_many_stamps_each() -> None:
    both = np.concatenate([STAMPS, STAMPS])  # of two LiDARs
    assert part_of_scan(both).tolist() == [*(np.arange(2 * PARTS) // 2)] * 2
    assert part_of_scan(STAMPS[:3]).tolist() == [0, PARTS // 3, 2 * PARTS // 3]


def test_what_sightings_say_of_slips() -> None:
    """Their columns are those of the extrinsic in later scans; offsets of surfaces eliminated."""
    rng = np.random.default_rng(4)
    layout = Layout(poses=1, parameters=0, offsets=(), lidars=2, surface_of=())
    scan_lidar = np.repeat([0, 1], len(STAMPS))
    scan = np.repeat(np.arange(len(scan_lidar)), 3)
    q = len(scan)
    J = rng.standard_normal((4 * q, layout.size))
    own = layout.extrinsic + 6 * scan_lidar[np.tile(scan, 4)][:, None] + np.arange(6)
    of_own = np.zeros((4 * q, layout.size), dtype=bool)
    np.put_along_axis(of_own, own, True, axis=1)
    J[:, layout.extrinsic : layout.error][~of_own[:, layout.extrinsic : layout.error]] = 0.0
    group = np.repeat(np.arange(len(scan_lidar)), 3)
    B = np.zeros((4 * q, len(scan_lidar)))
    B[np.arange(q), group] = rng.standard_normal(q)
    r, of_shared = rng.standard_normal(4 * q), rng.standard_normal(len(scan_lidar))
    of_each = rng.standard_normal((q, 6))
    rows = Rows(
        scipy.sparse.csr_array(J),
        r,
        scipy.sparse.csr_array(B),
        np.zeros(layout.size),
        of_shared,
        scan,
        np.arange(len(scan_lidar)),
        of_each,
    )

    found = slip_coupling(rows, layout, scan_lidar, np.tile(STAMPS, 2))

    by, noise = np.zeros((4 * q, 2 * EACH)), np.zeros(2 * EACH)
    part = part_of_scan(np.tile(STAMPS, 2))
    for row in range(4 * q):
        a, p = scan_lidar[scan[row % q]], part[scan[row % q]]
        if p > 0:
            at = EACH * a + 6 * (p - 1)
            by[row, at : at + 6] = J[row, layout.extrinsic + 6 * a : layout.extrinsic + 6 * a + 6]
            noise[at : at + 6] += of_each[row] if row < q else 0.0
    weight = np.eye(4 * q) - B @ np.linalg.inv(np.eye(B.shape[1]) + B.T @ B) @ B.T
    inner = np.linalg.inv(np.eye(B.shape[1]) + B.T @ B)
    assert found.rows.toarray() == pytest.approx(by.T @ weight @ J)
    assert found.information == pytest.approx(by.T @ weight @ by)
    pull = noise - by.T @ weight @ r - by.T @ B @ inner @ of_shared
    assert found.gradient == pytest.approx(pull)


@pytest.mark.parametrize("sigma_s", [0.0, 2e-3])
def test_clocks_and_jitters_are_eliminated(sigma_s: float) -> None:
    """As their covariance in a Gaussian says: slips see them as noise."""
    rng = np.random.default_rng(5)
    scan_lidar = np.array([0, 0, 0, 1, 1])
    J = rng.standard_normal((40, 8))
    r = rng.standard_normal(40)
    A, u = J.T @ J, J.T @ r
    together = scan_lidar[:, None] == scan_lidar
    cov = OFFSET_SIGMA_S**2 * together + sigma_s**2 * np.eye(5)
    noise = np.linalg.inv(np.eye(40) + J[:, :5] @ cov @ J[:, :5].T)

    H, b = told_slips(A, u, sigma_s, scan_lidar, 2)

    assert pytest.approx(J[:, 5:].T @ noise @ J[:, 5:]) == H
    assert b == pytest.approx(J[:, 5:].T @ noise @ r)


def told(truth: Array, common: float = 0.0) -> ToldSlips:
    """Two LiDARs, all x (2, PARTS - 1, 6) known to 0.1 mrad and 1 mm.

    Beside this `common` is 1 sigma of what moves both LiDARs alike in a part, mrad and cm about
    the origin of the vehicle.
    """
    cov = np.diag(np.tile(np.repeat([1e-4, 1e-3], 3), 2 * (PARTS - 1)) ** 2)
    for p in range(PARTS - 1):
        both = np.zeros((2, PARTS - 1, 6, 6))
        for i in range(2):
            both[i, p] = T[i].inverse().AdjointMap()
        flat = both.reshape(-1, 6)
        cov += flat @ np.diag(np.repeat([1e-3, 1e-2], 3) * common) ** 2 @ flat.T
    H = np.linalg.inv(cov)
    return ToldSlips(("front", "rear"), np.tile(STAMPS, 2), H, H @ truth.ravel(), T)


def slipped(own: int, part: int) -> Array:
    out = np.zeros((2, PARTS - 1, 6))
    out[own, part - 1 :] = BY
    return out


def test_the_lidar_that_slips_is_named() -> None:
    for own, part in ((0, 4), (1, 4), (1, 1), (0, PARTS - 1)):
        found = told(slipped(own, part)).slip()
        assert (found.lidars, found.others) == ((("front", "rear")[own],), ())
        assert (found.since_s, found.lasts_s) == (2.0 * part, 2.0 * PARTS - 1.0)
        R = T[own].rotation().matrix()
        expected = np.concatenate([R @ BY[:3], R @ BY[3:]])
        assert found.change == pytest.approx(expected, abs=1e-5)
        # 17 mrad by the allowance of 0.3 mrad.
        assert found.sigmas > 20.0


def test_without_an_absolute_reference_either_may_have_slipped() -> None:
    found = told(slipped(1, 4), common=100.0).slip()
    assert {*found.lidars, *found.others} == {"front", "rear"}
    assert len(found.lidars) == 1
    assert found.since_s == 8.0
    assert found.sigmas > 20.0


def test_all_that_move_alike_are_named_together() -> None:
    truth = np.zeros((2, PARTS - 1, 6))
    for i in range(2):
        truth[i, 2:] = T[i].inverse().AdjointMap() @ BY
    found = told(truth).slip()
    assert (found.lidars, found.others, found.since_s) == (("front", "rear"), (), 6.0)
    assert found.change == pytest.approx(BY, abs=1e-4)


def test_a_single_lidar_is_told_by_the_motion_data_alone() -> None:
    """These have errors of 3 mrad in each part: of half the parts against the others 2.1 mrad."""
    both = told(slipped(0, 4))
    H, b = both.information[:EACH, :EACH], both.gradient[:EACH]
    found = ToldSlips(("front",), STAMPS, H, b, T[:1]).slip()
    assert (found.lidars, found.others, found.alone) == (("front",), (), True)
    # (17 / 2.1)^2 of a chi-square with 6 degrees of freedom.
    assert found.sigmas == pytest.approx(6.9, abs=0.1)


def test_what_swings_is_no_slip() -> None:
    """A soft mount: each part has its own mean, of 0.5 mrad; noise alone is nothing."""
    rng = np.random.default_rng(6)
    sizes = np.repeat([5e-4, 1e-3], 3)
    for scale in (1.0, 0.2):
        draws = [told(scale * sizes * rng.standard_normal((2, PARTS - 1, 6))) for _ in range(20)]
        sigmas = [draw.slip().sigmas for draw in draws]
        assert max(sigmas) < CONTRADICTION_SIGMAS
        assert np.median(sigmas) < 3.0


def errors_of_motion(rng: np.random.Generator, lidars: int, joins: int = 0) -> ToldSlips:
    """Poses in error by `MOTION_ALLOWANCE` in each part, by which all LiDARs seem to move.

    LiDARs but the first see nothing before part `joins`: what they are there is not known.
    """
    at = [gtsam.Rot3.RzRyRx(0.1 * i, 0.2, 2.1 * i) for i in range(lidars)]
    T = tuple(gtsam.Pose3(R, np.array([3.0 * i, 1.0, 2.0])) for i, R in enumerate(at))
    errors = MOTION_ALLOWANCE * rng.standard_normal((PARTS, 6))
    H = np.zeros((lidars, EACH, lidars, EACH))
    truth = np.zeros((lidars, PARTS - 1, 6))
    for i in range(lidars):
        truth[i] = (errors[1:] - errors[0]) @ T[i].inverse().AdjointMap().T
        known = np.eye(PARTS - 1)
        if i and joins:
            later = np.arange(PARTS - 1) >= joins - 1
            known = np.diag(1.0 * later) - np.outer(later, later) / later.sum()
        H[i, :, i] = np.kron(known, np.diag(np.repeat([1e-4, 1e-3], 3) ** -2.0))
    flat = H.reshape(lidars * EACH, -1)
    names = tuple(f"lidar {i}" for i in range(lidars))
    return ToldSlips(names, np.tile(STAMPS, lidars), flat, flat @ truth.ravel(), T)


@pytest.mark.parametrize(("lidars", "joins"), [(1, 0), (2, 0), (4, 0), (8, 0), (2, 4), (4, 2)])
def test_errors_of_the_motion_data_are_no_slip(lidars: int, joins: int) -> None:
    """However many LiDARs see them, and whether each sees all of the drive."""
    rng = np.random.default_rng(7)
    sigmas = [errors_of_motion(rng, lidars, joins).slip().sigmas for _ in range(40)]
    assert max(sigmas) < CONTRADICTION_SIGMAS
    assert np.median(sigmas) < 2.0


def test_a_lidar_whose_slip_no_other_one_sees_is_alone() -> None:
    """The others see nothing: the motion data, or IMU and antenna, may be what moved."""
    assert not told(slipped(1, 4)).slip().alone
    H = told(slipped(1, 4)).information
    H[:EACH] = H[:, :EACH] = 0.0
    found = ToldSlips(("front", "rear"), np.tile(STAMPS, 2), H, H @ slipped(1, 4).ravel(), T).slip()
    assert found.lidars == ("rear",)
    assert found.alone
