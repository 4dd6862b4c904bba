"""The ranking of suspects: numbers by hand, and what chance alone explains."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.stats import chi2, kstest, norm

from caliv_graph.uncertainty.suspects import Candidate, Scores, assembled, log_tail, ranking


def candidate(name: str, size: int = 1, allowance: float = 0.0, scale: float = 100.0) -> Candidate:
    return Candidate(name, np.full(size, allowance), np.full(size, scale))


def scores(candidates: list[Candidate], information: ArrayLike, gradient: ArrayLike) -> Scores:
    return Scores(tuple(candidates), np.asarray(information, float), np.asarray(gradient, float))


def test_a_single_input_by_hand() -> None:
    """Information 4, gradient 12: a change by 3 +- 0.5, which takes 12 * 3 = 36 off chi-square."""
    (found,) = ranking(scores([candidate("a")], [[4.0]], [12.0]))
    assert found.freed.change == pytest.approx([3.0])
    assert found.freed.cov == pytest.approx(np.array([[0.25]]))
    assert found.freed.squares == pytest.approx(36.0)
    assert found.freed.sigmas == pytest.approx(6.0)
    assert found.explains == 1.0


def test_an_allowance_is_no_contradiction() -> None:
    """3 +- 0.5 with an allowance of 1.2: 3 / 1.3 sigma."""
    (found,) = ranking(scores([candidate("a", allowance=1.2)], [[4.0]], [12.0]))
    assert found.freed.sigmas == pytest.approx(3.0 / 1.3)


def test_the_allowance_of_another_input_is_considered() -> None:
    """Both say the same of the data; b may be off by 2, so that a is known to 2 only."""
    both = scores(
        [candidate("a"), candidate("b", allowance=2.0)], np.ones((2, 2)) * 1e6, [3e6, 3e6]
    )
    a = both.freed([0])
    assert a.sigmas == pytest.approx(1.5, abs=1e-3)


def test_one_input_that_explains_all_leaves_nothing_for_the_others() -> None:
    """Columns of five measurements with unit noise; the third input is off, the others follow."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(50, 4)) + 1.0
    r = A[:, 2] * 9.0 + rng.normal(size=50)
    names = [candidate(n) for n in "abcd"]
    first, *rest = ranking(scores(names, A.T @ A, A.T @ r))
    assert first.candidate.name == "c"
    assert first.freed.change == pytest.approx([9.0], abs=0.5)
    assert first.explains > 0.95
    assert any(other.freed.sigmas > 5.0 for other in rest)
    assert all(other.sigmas_left < 3.0 for other in rest)


def test_of_two_that_explain_the_same_the_simpler_one_comes_first() -> None:
    J = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    c = J.T @ np.array([8.0, 8.0])
    wide, narrow = candidate("two", 2), candidate("one", 1)
    order = [r.candidate.name for r in ranking(scores([narrow, wide], J.T @ J, c))]
    assert order == ["one", "two"]


def test_the_order_of_the_inputs_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(40, 6))
    c = A.T @ rng.normal(size=40) * 3.0
    parts = [candidate("a", 2, 0.1), candidate("b", 1, 0.3), candidate("c", 3)]
    columns = {"a": [0, 1], "b": [2], "c": [3, 4, 5]}
    found = {r.candidate.name: r for r in ranking(scores(parts, A.T @ A, c))}
    turned = [parts[2], parts[0], parts[1]]
    order = [i for p in turned for i in columns[p.name]]
    again = {
        r.candidate.name: r
        for r in ranking(scores(turned, (A.T @ A)[np.ix_(order, order)], c[order]))
    }
    for name, r in found.items():
        assert again[name].freed.squares == pytest.approx(r.freed.squares)
        assert again[name].sigmas_left == pytest.approx(r.sigmas_left)


def test_what_the_data_do_not_tell_is_left_out() -> None:
    """The second coordinate has a sigma of 1000, beyond its scale of 100."""
    (found,) = ranking(scores([candidate("a", 2)], np.diag([1.0, 1e-6]), [4.0, 1e-3]))
    assert found.freed.dof == 1
    assert found.freed.change == pytest.approx([4.0, 0.0])
    assert found.freed.determined.tolist() == [True, False]
    assert math.sqrt(found.freed.cov[1, 1]) == pytest.approx(1000.0)


def test_chance_alone_is_uniform_in_p() -> None:
    """Sound inputs that err by their allowances, noise of unit variance: p-values are uniform."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(60, 5))
    parts = [candidate("a", 2, 0.2), candidate("b", 1, 0.5), candidate("c", 2)]
    allowance = np.concatenate([p.allowance for p in parts])
    p = []
    for _ in range(400):
        r = A @ (allowance * rng.normal(size=5)) + rng.normal(size=60)
        p.append(math.exp(scores(parts, A.T @ A, A.T @ r).freed([0]).log_p))
    assert kstest(p, "uniform").pvalue > 1e-3


def test_noise_of_twice_the_stated_sigma_is_no_contradiction_with_its_misfit() -> None:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(60, 1))
    stated = [
        Scores((candidate("a"),), A.T @ A, A.T @ (2.0 * rng.normal(size=60)), misfit=4.0)
        for _ in range(200)
    ]
    sigmas = np.array([s.freed([0]).sigmas for s in stated])
    assert (sigmas**2).mean() == pytest.approx(1.0, abs=0.35)


def test_variables_are_eliminated_under_their_evidence() -> None:
    """The same as one linear solve with the parameters among the variables."""
    rng = np.random.default_rng(5)
    J, C = rng.normal(size=(30, 6)), rng.normal(size=(30, 3))
    r = rng.normal(size=30)
    reduced = assembled([candidate("a", 3)], C.T @ C, C.T @ r, J.T @ C, J.T @ J, J.T @ r)
    whole, *_ = np.linalg.lstsq(np.hstack([J, C]), r, rcond=None)
    assert reduced.freed([0]).change == pytest.approx(whole[6:], rel=1e-6)


@pytest.mark.parametrize(("squares", "dof"), [(0.5, 1), (30.0, 3), (900.0, 6)])
def test_tail_of_chi_square(squares: float, dof: int) -> None:
    assert log_tail(squares, dof) == pytest.approx(float(chi2.logsf(squares, dof)), rel=1e-9)


def test_tail_goes_on_where_numbers_end() -> None:
    """60 sigma of one degree of freedom: p is 1e-784."""
    (found,) = ranking(scores([candidate("a")], [[1.0]], [60.0]))
    assert found.freed.sigmas == pytest.approx(60.0, rel=1e-6)
    assert log_tail(3600.0, 1) == pytest.approx(math.log(2.0) + float(norm.logsf(60.0)), rel=1e-6)
    # Both forms agree where one takes over from the other.
    assert log_tail(1199.9, 3) - log_tail(1200.1, 3) == pytest.approx(0.1, rel=1e-2)
