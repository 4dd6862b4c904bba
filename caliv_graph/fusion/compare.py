"""Has a mount moved? A test of the extrinsics of two drives against each other.

The test uses the information of the data alone, because a shared guess would make two calibrations
agree. It has no power along directions that one of the drives does not determine
(caliv_graph/uncertainty/README.md), and names them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc, ndtr

from caliv_graph.config.guesses import prior_sigmas
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.terms import arranged, fuse, guess_of, only, own_term, slid
from caliv_graph.geometry.covariance import relative_jacobian
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, Calibration, DataTerm, Guess
from caliv_graph.uncertainty.observability import (
    AXIS_SHARE,
    LIDAR_SHARE,
    UNIT,
    assess,
    scaling,
    spectrum,
)
from caliv_graph.uncertainty.pairs import sensor_pairs
from caliv_graph.wording.directions import named
from caliv_graph.wording.movements import moved_sentence, shared_sentence

ALPHA = 0.01
"""Probability of a false alarm if no mount has moved, over all tests of one comparison."""

_MAX_PRIOR_FRACTION = 0.1
"""Largest fraction of the variance of a direction or an axis that may come from undetermined
directions. With more it is not tested. Below it, the test is slightly conservative."""


@dataclass(frozen=True)
class Movement:
    """Movement of a LiDAR against the vehicle or against another LiDAR.

    Attributes:
        lidars: one name: against the vehicle. Two, `from` and `to`: the first against the second.
        movement: (6,) second calibration minus the first, vehicle axes at the (first) LiDAR,
            rotation (rad) then translation (m).
        sigma: (6,) standard deviation of the movement.
        determined: (6,) whether both drives determine the axis, and the guesses hardly have a part
            in its variance. The movement and sigma of other axes have no meaning.
        chi2: chi-square of the movement along the directions that both drives determine.
        dof: number of these directions; 0: no test is possible.
        p_value: probability of a larger `chi2` if nothing has moved.
        p_axes: (6,) p-value of each determined axis by itself, more sensitive to a movement along
            a single axis; 1 for the others.
        p_corrected: the smallest of all these p-values, corrected for the number of tests
            (Holm 1979).
        moved: whether `p_corrected` is below the limit.
    """

    lidars: tuple[str, ...]
    movement: Array
    sigma: Array
    determined: tuple[bool, ...]
    chi2: float
    dof: int
    p_value: float
    p_axes: Array
    p_corrected: float = 1.0
    moved: bool = False

    @property
    def tests(self) -> list[float]:
        """P-values of all tests of this movement."""
        if not self.dof:
            return []
        return [self.p_value, *(float(p) for p in self.p_axes[list(self.determined)])]


@dataclass(frozen=True)
class Comparison:
    """Two calibrations against each other.

    Attributes:
        lidars: LiDAR against vehicle.
        pairs: LiDAR against LiDAR.
        chi2: chi-square of all LiDARs together.
        dof: its degrees of freedom.
        p_value: its p-value.
        moved: the verdict: whether any movement is significant after the correction.
        conclusion: the verdict in words.
        not_compared: LiDARs left out, with the reason.
        undetermined: directions that the first and the second drive do not determine, in words.
        shared: recordings whose data are in both. The test takes the two as independent: with
            common errors a difference is smaller than its sigma says, so that it rather misses a
            movement than invents one.
    """

    lidars: Mapping[str, Movement]
    pairs: tuple[Movement, ...]
    chi2: float
    dof: int
    p_value: float
    moved: bool
    conclusion: str
    not_compared: Mapping[str, str]
    undetermined: tuple[tuple[str, ...], tuple[str, ...]]
    shared: tuple[str, ...] = ()

    @property
    def movements(self) -> tuple[Movement, ...]:
        """Movements of all LiDARs and all pairs."""
        return (*self.lidars.values(), *self.pairs)


@dataclass(frozen=True)
class _Drive:
    """Determined and undetermined directions of one drive, over the LiDARs of the comparison.

    Attributes:
        poses: extrinsics that the data alone give along the determined directions.
        root_data: (6n, k) root of the data's covariance along the determined directions, vehicle
            axes.
        root_prior: (6n, m) root of the guesses' covariance along the undetermined directions.
        null: (6n, m) undetermined directions, in scaled units, orthonormal.
        undetermined: the undetermined directions in words.
    """

    poses: Mapping[str, gtsam.Pose3]
    root_data: Array
    root_prior: Array
    null: Array
    undetermined: tuple[str, ...]


def compare(
    first: Calibration,
    second: Calibration,
    labels: tuple[str, str],
    p_value: float = ALPHA,
) -> Comparison:
    """Tests whether the mounts have moved between two calibrations of one vehicle.

    Args:
        first: the earlier one.
        second: the later one.
        labels: their names in messages (their files).
        p_value: probability of a false alarm over all tests.

    Raises:
        ConfigError: they have no LiDAR in common.
    """
    terms = own_term(first, labels[0]), own_term(second, labels[1])
    if not set(first.lidars) & set(second.lidars):
        raise ConfigError(
            f"{labels[1]}: has none of the LiDARs of {labels[0]} ({', '.join(first.lidars)}), but "
            f"{', '.join(second.lidars)}. Give them the same names"
        )
    before, after = ({n: guess_of(c, n) for n in c.lidars} for c in (first, second))
    found = compare_terms(terms, (before, after), first.reference, p_value)
    shared = tuple(source for source in terms[0].sources if source in terms[1].sources)
    if not shared:
        return found
    same = set(terms[0].sources) == set(terms[1].sources)
    said = shared_sentence(found.conclusion, same, *_moved(found))
    return replace(found, shared=shared, conclusion=said)


def compare_terms(
    terms: tuple[DataTerm, DataTerm],
    guesses: tuple[Mapping[str, Guess], Mapping[str, Guess]],
    reference: str,
    p_value: float,
) -> Comparison:
    """Like `compare`, for the information of two sets of drives.

    Args:
        terms: information of each, independent of each other.
        guesses: guesses of each. They only decide which directions count as determined.
        reference: the LiDAR that is second in its pairs.
        p_value: see `compare`.
    """
    names, left_out = _comparable(terms)
    near = _slid_together(terms, guesses, names)
    drives = _drive(near[0], guesses[0], names), _drive(near[1], guesses[1], names)
    lidars = {name: _movement((name,), names, drives) for name in names}
    pairs = tuple(_movement(pair, names, drives) for pair in sensor_pairs(names, reference))
    tested = holm([*lidars.values(), *pairs], p_value)
    lidars = dict(zip(names, tested, strict=False))
    pairs = tuple(tested[len(names) :])
    chi2, dof, p = (0.0, 0, 1.0)
    if names:
        everything = np.concatenate(
            [vehicle_axes_difference(drives[1].poses[n], drives[0].poses[n]) for n in names]
        )
        identity = np.eye(len(everything))
        chi2, dof, p = _test(everything, [(identity, drive) for drive in drives])
    found = Comparison(
        lidars=lidars,
        pairs=pairs,
        chi2=chi2,
        dof=dof,
        p_value=p,
        moved=any(m.moved for m in tested),
        conclusion="",
        not_compared=left_out,
        undetermined=(drives[0].undetermined, drives[1].undetermined),
    )
    any_test = any(m.dof for m in tested)
    return replace(found, conclusion=moved_sentence(any_test, len(lidars), *_moved(found)))


def holm(movements: Sequence[Movement], p_value: float) -> list[Movement]:
    """Corrects p-values for the number of tests (Holm 1979), and decides.

    Args:
        movements: those without degrees of freedom count as no test.
        p_value: probability of a false alarm over all tests.
    """
    tests = sorted((p, i) for i, movement in enumerate(movements) for p in movement.tests)
    smallest: dict[int, float] = {}
    corrected = 0.0
    for rank, (p, i) in enumerate(tests):
        corrected = max(corrected, min(1.0, (len(tests) - rank) * p))
        smallest.setdefault(i, corrected)
    return [
        replace(movement, p_corrected=smallest[i], moved=smallest[i] < p_value)
        if i in smallest
        else movement
        for i, movement in enumerate(movements)
    ]


def _comparable(terms: tuple[DataTerm, DataTerm]) -> tuple[list[str], dict[str, str]]:
    """LiDARs on which both drives have information, and why the others are left out."""
    known = [
        {
            name: bool(np.any(np.diag(term.information)[6 * i : 6 * i + 6] > 0.0))
            for i, name in enumerate(term.T_vehicle_lidar)
        }
        for term in terms
    ]
    names, left_out = [], {}
    for name in dict.fromkeys([*known[0], *known[1]]):
        absent = [
            which for which, s in zip(("first", "second"), known, strict=True) if name not in s
        ]
        blind = [
            which
            for which, s in zip(("first", "second"), known, strict=True)
            if not s.get(name, True)
        ]
        if absent:
            left_out[name] = f"the {absent[0]} calibration does not have it"
        elif blind:
            left_out[name] = f"it saw nothing in the {' and the '.join(blind)} calibration"
        else:
            names.append(name)
    return names, left_out


def _slid_together(
    terms: tuple[DataTerm, DataTerm],
    guesses: tuple[Mapping[str, Guess], Mapping[str, Guess]],
    names: Sequence[str],
) -> tuple[DataTerm, DataTerm]:
    """The terms over some LiDARs, each slid along what it leaves undetermined to where both meet.

    What is left of their difference is small enough for a linear test. Where nobody gave a guess,
    two solves may end half a radian apart along such a direction.
    """
    first, second = (only(term, names) for term in terms)
    both = fuse((first, second), {n: guesses[0][n] for n in names}).T_vehicle_lidar
    return slid(first, both, guesses[0]), slid(second, both, guesses[1])


def _drive(term: DataTerm, guesses: Mapping[str, Guess], names: Sequence[str]) -> _Drive:
    """Splits a drive's information on some LiDARs into determined and undetermined directions."""
    D, c = arranged(term, names)
    unit = scaling(len(names))
    sigmas = [prior_sigmas(guesses[n]) for n in names]
    prior = np.diag(np.concatenate([*sigmas, np.zeros(0)]) ** -2.0)
    if not names:
        return _Drive({}, np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0)), ())
    split = spectrum(D, prior)
    W, U = split.vectors[:, ~split.undetermined], split.vectors[:, split.undetermined]
    information = split.information[~split.undetermined]
    step = unit * (W @ ((W.T @ (unit * c)) / information))
    poses = {
        name: retract_vehicle_axes(term.T_vehicle_lidar[name], step[6 * i : 6 * i + 6])
        for i, name in enumerate(names)
    }
    root_prior = np.zeros((len(unit), 0))
    if U.shape[1]:
        certainty = U.T @ (prior * np.outer(unit, unit)) @ U
        root_prior = unit[:, None] * U @ np.linalg.inv(np.linalg.cholesky(certainty)).T
    return _Drive(
        poses=poses,
        root_data=unit[:, None] * W / np.sqrt(information),
        root_prior=root_prior,
        null=U,
        undetermined=tuple(d.text for d in named(assess(D, prior, poses), poses).undetermined),
    )


def _movement(
    lidars: tuple[str, ...], names: Sequence[str], drives: tuple[_Drive, _Drive]
) -> Movement:
    """The movement of a LiDAR against the vehicle, or of one LiDAR against another."""
    before, after = drives
    if len(lidars) == 1:
        (name,) = lidars
        movement = vehicle_axes_difference(after.poses[name], before.poses[name])
    else:
        # The pose of the first LiDAR if the second had not moved.
        source, to = lidars
        T_to_from = after.poses[to].between(after.poses[source])
        expected = before.poses[to].compose(T_to_from)
        movement = vehicle_axes_difference(expected, before.poses[source])
    parts = [(_selection(lidars, names, drive.poses), drive) for drive in drives]
    chi2, dof, p_value = _test(movement, parts)
    var_data, var_prior = (
        sum((np.sum((J @ root) ** 2, axis=1) for J, root in roots), start=np.zeros(6))
        for roots in (
            [(J, drive.root_data) for J, drive in parts],
            [(J, drive.root_prior) for J, drive in parts],
        )
    )
    variance = var_data + var_prior
    undetermined = np.any([_undetermined_axes(J, drive) for J, drive in parts], axis=0)
    # Along what the drives leave open, even a small part of an axis can be off by any amount.
    undetermined |= var_prior > _MAX_PRIOR_FRACTION * variance
    sigma = np.sqrt(variance)
    p_axes = np.where(undetermined, 1.0, 2.0 * ndtr(-np.abs(movement) / sigma))
    return Movement(
        lidars=lidars,
        movement=movement,
        sigma=sigma,
        determined=tuple(not bool(axis) for axis in undetermined),
        chi2=chi2,
        dof=dof,
        p_value=p_value,
        p_axes=p_axes,
    )


def _selection(
    lidars: tuple[str, ...], names: Sequence[str], poses: Mapping[str, gtsam.Pose3]
) -> Array:
    """(6, 6n) derivative of a movement with respect to all extrinsics, vehicle axes."""
    J = np.zeros((6, 6 * len(names)))
    if len(lidars) == 1:
        start = 6 * names.index(lidars[0])
        J[:, start : start + 6] = np.eye(6)
        return J
    a, b = (poses[name] for name in lidars)
    axes = [right_to_vehicle_axes(T) for T in (a, b)]
    both = axes[0] @ relative_jacobian(a, b) @ block_diag(*axes).T
    for k, name in enumerate(lidars):
        start = 6 * names.index(name)
        J[:, start : start + 6] = both[:, 6 * k : 6 * k + 6]
    return J


def _undetermined_axes(J: Array, drive: _Drive) -> Array:
    """(6,) bool: axes with a component in the undetermined directions (uncertainty/README.md)."""
    if not drive.null.shape[1]:
        return np.zeros(6, dtype=bool)
    unit = scaling(J.shape[1] // 6)
    part = np.sum(((J * unit / UNIT[:, None]) @ drive.null) ** 2, axis=1)
    total = float(part.sum())
    return np.asarray((part > AXIS_SHARE * total) & (total > LIDAR_SHARE))


def _test(difference: Array, parts: Sequence[tuple[Array, _Drive]]) -> tuple[float, int, float]:
    """Chi-square of a difference along the directions that both drives determine.

    Args:
        difference: (k,), vehicle axes.
        parts: per drive, the (k, 6n) derivative of the difference by its extrinsics.

    Returns:
        Chi-square, degrees of freedom, p-value.
    """
    unit = scaling(len(difference) // 6)
    cov_data, cov_prior = (
        sum(
            (_squared(J @ root / unit[:, None]) for J, root in roots),
            start=np.zeros((len(unit),) * 2),
        )
        for roots in (
            [(J, drive.root_data) for J, drive in parts],
            [(J, drive.root_prior) for J, drive in parts],
        )
    )
    values, vectors = np.linalg.eigh(cov_data + cov_prior)
    whiten = vectors[:, values > 0.0] / np.sqrt(values[values > 0.0])
    # 0 where both drives determine a direction, 1 where one of them has no information on it.
    fraction, turn = np.linalg.eigh(whiten.T @ cov_prior @ whiten)
    whitened = (whiten @ turn[:, fraction < _MAX_PRIOR_FRACTION]).T @ (difference / unit)
    dof = len(whitened)
    chi2 = float(whitened @ whitened)
    return chi2, dof, float(chdtrc(dof, chi2)) if dof else 1.0


def _squared(root: Array) -> Array:
    return np.asarray(root @ root.T)


def _moved(found: Comparison) -> tuple[list[str], list[tuple[str, str]]]:
    """LiDARs that moved against the vehicle, and pairs that moved against each other."""
    apart = [(m.lidars[0], m.lidars[1]) for m in found.pairs if m.moved]
    return [name for name, m in found.lidars.items() if m.moved], apart
