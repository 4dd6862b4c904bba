"""S2S of the calibration against that of a solve of the drive's structure, pair by pair.

Distances on held-out strips are measured on poses that the other strips have with the calibration:
these follow a wrong x or y as far as the motion data let them, and may hide it. The extrinsics of
the solve do not know the calibration.
"""

from __future__ import annotations

import gtsam
import numpy as np
import scipy.linalg
from scipy.special import chdtrc

from caliv_graph.geometry.covariance import relative_jacobian
from caliv_graph.geometry.se3 import joint_right_to_vehicle_axes, right_to_vehicle_axes
from caliv_graph.products import Array
from caliv_graph.structure.elimination import covariance_of
from caliv_graph.structure.solve import Solved
from caliv_graph.uncertainty.pairs import sensor_pairs
from caliv_graph.validation.clouds import Extrinsics
from caliv_graph.validation.findings import PairTest

TOLD = 0.1
"""Largest part of a variance before the drive, that of the guesses, with which the structure tells
a direction or an axis. Others are not tested: where they ended is the guess."""


def pair_tests(
    used: Solved, extrinsics: Extrinsics, cov: Array, reference: str
) -> tuple[PairTest, ...]:
    """The test of each pair of LiDARs, `reference` second where it is one of them.

    Args:
        used: the solve.
        extrinsics: the calibration, of the same LiDARs.
        cov: (6 L, 6 L) of it, right perturbations. Its errors and those of the solve are taken as
            independent: on the calibrated drive the test is conservative.
        reference: LiDAR.
    """
    names = used.problem.patches.lidars
    T_solved = used.state.T_vehicle_lidar
    own = np.arange(used.layout.extrinsic, used.layout.error)
    cov_solved = covariance_of(used.factor, own)
    axes = joint_right_to_vehicle_axes(T_solved)
    guessed = axes.T @ np.linalg.inv(used.problem.held_information) @ axes
    out = []
    for pair in sensor_pairs(names, reference):
        a, b = (names.index(name) for name in pair)
        rows = [*range(6 * a, 6 * a + 6), *range(6 * b, 6 * b + 6)]
        before, told, stated = (C[np.ix_(rows, rows)] for C in (guessed, cov_solved, cov))
        found = T_solved[a], T_solved[b]
        file = extrinsics.T_vehicle_lidar[pair[0]], extrinsics.T_vehicle_lidar[pair[1]]
        out.append(_test(pair, found, file, before, told, stated))
    return tuple(out)


def _test(
    pair: tuple[str, str],
    found: tuple[gtsam.Pose3, gtsam.Pose3],
    file: tuple[gtsam.Pose3, gtsam.Pose3],
    before: Array,
    told: Array,
    stated: Array,
) -> PairTest:
    """Of `T_vehicle_lidar` (a, b); (12, 12) of the guesses, of the solve and of the file."""
    J = right_to_vehicle_axes(found[0]) @ relative_jacobian(*found)
    before, told, stated = (J @ C @ J.T for C in (before, told, stated))
    T_b_a = found[1].between(found[0])
    off = right_to_vehicle_axes(found[0]) @ T_b_a.localCoordinates(file[1].between(file[0]))
    both = told + stated
    # Directions in which the prior has variance one; of the solve it is `share`.
    share, directions = scipy.linalg.eigh(told, before)
    tested = directions[:, share < TOLD]
    dof = tested.shape[1]
    along = tested.T @ off
    chi2 = float(along @ np.linalg.solve(tested.T @ both @ tested, along)) if dof else 0.0
    return PairTest(
        lidars=pair,
        off=off,
        sigma=np.sqrt(np.diag(both)),
        determined=tuple((np.diag(told) < TOLD * np.diag(before)).tolist()),
        chi2=max(chi2, 0.0),
        dof=dof,
        p_value=float(chdtrc(dof, max(chi2, 0.0))) if dof else None,
    )
