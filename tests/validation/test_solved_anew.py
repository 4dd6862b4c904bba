"""S2S of a calibration against that of the drive's structure, and of the halves of a drive."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.structure.solve import Solved
from caliv_graph.validation.clouds import Extrinsics
from caliv_graph.validation.findings import PairTest, Verdict
from caliv_graph.validation.solved_anew import pair_tests
from caliv_graph.validation.verdict import CONTRADICTION
from tests.structure.test_solve import in_yard
from tests.structure.yards import TRUE

SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3)
COV = np.diag(np.tile(SIGMAS**2, 2))


@pytest.fixture(scope="module")
def used() -> Solved:
    return in_yard()


def compared(used: Solved, **moved: np.ndarray) -> PairTest:
    rng = np.random.default_rng(4)
    poses = {name: T.retract(SIGMAS * rng.standard_normal(6)) for name, T in TRUE.items()}
    for name, d in moved.items():
        T = poses[name]
        poses[name] = gtsam.Pose3(T.rotation(), T.translation() + d)
    (found,) = pair_tests(used, Extrinsics(poses, {}), COV, "rear")
    return found


def test_a_right_calibration_agrees(used: Solved) -> None:
    found = compared(used)
    assert found.lidars == ("front", "rear")
    # The yard has walls alone: z stays where the guesses have it.
    assert found.dof == 5
    assert found.determined == (True, True, True, True, True, False)
    assert found.p_value is not None
    assert found.p_value > 1e-3
    # Told by walls all around: not much more than what the file states.
    assert found.sigma[3:5].max() < 0.01


def test_a_shift_is_seen_where_it_is(used: Solved) -> None:
    """In vehicle axes, whichever way the LiDAR looks."""
    found = compared(used, front=np.array([0.0, 0.05, 0.0]))
    usual = compared(used)
    assert found.p_value is not None
    assert found.p_value < CONTRADICTION
    assert found.off - usual.off == pytest.approx([0, 0, 0, 0, 0.05, 0], abs=1e-4)
    assert found.worst.axis == 4
    assert found.worst.most.startswith(", y +")
    assert found.worst.sigmas > 5.0
    # The other way about where the second is moved.
    other = compared(used, rear=np.array([0.0, 0.05, 0.0]))
    assert other.off[4] - usual.off[4] == pytest.approx(-0.05, abs=1e-4)


def test_what_structure_does_not_tell_is_not_tested(used: Solved) -> None:
    """With guesses that are known better than structure knows anything, nothing is told by it."""
    certain = np.eye(12) * 1e12
    held = replace(used.problem, held_information=certain)
    found = compared(replace(used, problem=held), front=np.array([0.0, 0.05, 0.0]))
    assert (found.dof, found.p_value) == (0, None)
    assert found.worst.axis == -1
    assert found.worst.most == ""


def test_another_test_may_make_a_verdict_worse_and_never_better() -> None:
    verdict = Verdict("unclear", None, "distance", None, 0.0, 0, None, False, ("Nothing.",))
    same = verdict.also(("It agrees.",))
    assert (same.word, same.contradicts, same.reason) == ("unclear", False, "")
    assert same.sentences == ("Nothing.", "It agrees.")
    worse = same.also(("It is elsewhere.",), contradicts=True)
    assert (worse.word, worse.contradicts) == ("contradicted", True)
    assert worse.reason == "It is elsewhere."
    assert replace(verdict, word="worse").also(("Elsewhere.",), contradicts=True).word == "worse"
