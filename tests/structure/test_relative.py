"""The places of LiDARs to each other out of a solve with one of them held."""

from __future__ import annotations

import gtsam
import numpy as np

from caliv_graph.structure.relative import relative_quadratic


def test_a_common_motion_changes_nothing_and_a_relative_one_all_it_did() -> None:
    rng = np.random.default_rng(3)
    T = [gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(3)]
    A = rng.normal(size=(30, 18))
    H, b = A.T @ A, rng.normal(size=18)
    found, pull = relative_quadratic(H, b, T, tracked=1)
    # G T_a = T_a Exp(Ad(T_a^-1) g).
    common = np.vstack([pose.inverse().AdjointMap() for pose in T])
    np.testing.assert_allclose(found @ common, 0.0, atol=1e-9)
    np.testing.assert_allclose(pull @ common, 0.0, atol=1e-9)
    others = [i for i in range(18) if not 6 <= i < 12]
    np.testing.assert_allclose(found[np.ix_(others, others)], H[np.ix_(others, others)])
    np.testing.assert_allclose(pull[others], b[others])
