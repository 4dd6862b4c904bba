"""Has a mount moved? What two drives say about the extrinsics, tested against each other.

Only what the data themselves say takes part: a guess that two calibrations share would make them
agree. Along a direction that either drive did not determine (SPEC 4) nothing can be said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc, ndtr

from caliv_graph.calibration.guesses import DEFAULT_GUESS_SIGMAS
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.terms import arranged, guess_of, own_term
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

ALPHA = 0.01
"""Chance of a false alarm when nothing has moved, over all tests of one comparison."""

_LEAK_SHARE = 0.1
"""Share of what is not determined in the variance of a direction, above which it is not tested. Up
to it the test is a little too cautious."""


@dataclass(frozen=True)
class Movement:
    """How far a LiDAR, or one against another, is from where it was.

    Attributes:
        lidars: one name: against the vehicle. Two, `from` and `to`: the first against the second.
        movement: (6,) vehicle axes at the (first) LiDAR, rotation (rad) then translation (m), the
            second calibration less the first.
        sigma: (6,) of it.
        told: (6,) whether both drives determine the axis; elsewhere the two numbers mean nothing.
        chi2: of the movement along the directions that both drives determine.
        dof: how many these are; 0: nothing can be said.
        p_value: chance of a larger `chi2` if nothing has moved.
        p_axes: (6,) the same of each axis that both determine, by itself: a mount that moved along
            one axis alone shows there first. 1 for the others.
        p_corrected: the smallest of all these, corrected for the number of tests (Holm 1979).
        moved: whether that is below the limit.
    """

    lidars: tuple[str, ...]
    movement: Array
    sigma: Array
    told: tuple[bool, ...]
    chi2: float
    dof: int
    p_value: float
    p_axes: Array
    p_corrected: float = 1.0
    moved: bool = False

    @property
    def tests(self) -> list[float]:
        """P-values of all tests of it."""
        if not self.dof:
            return []
        return [self.p_value, *(float(p) for p in self.p_axes[list(self.told)])]


@dataclass(frozen=True)
class Comparison:
    """Two calibrations against each other.

    Attributes:
        lidars: LiDAR against vehicle.
        pairs: LiDAR against LiDAR.
        chi2: of all LiDARs at once.
        dof: of that.
        p_value: of that.
        moved: the verdict: whether any movement is one, after the correction.
        conclusion: the verdict as a person says it.
        not_compared: LiDARs left out, and why.
        undetermined: what the first, and what the second, could not tell.
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

    @property
    def movements(self) -> tuple[Movement, ...]:
        """All that was tested, or could have been."""
        return (*self.lidars.values(), *self.pairs)


@dataclass(frozen=True)
class _Told:
    """What one drive determines, all matrices over the LiDARs of the comparison.

    Attributes:
        poses: where its data, along the directions they determine, put the LiDARs.
        data: (6n, k) root of their covariance along these, vehicle axes.
        leak: (6n, m) root of the guesses' covariance along the others: how far off the poses may
            be for what the data do not tell.
        lost: (6n, m) these other directions, in scaled units, orthonormal.
        undetermined: how a person says them.
    """

    poses: Mapping[str, gtsam.Pose3]
    data: Array
    leak: Array
    lost: Array
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
        labels: what to call them in messages (their files).
        p_value: chance of a false alarm over all tests.

    Raises:
        ConfigError: they stem from the same drive, or have no LiDAR in common.
    """
    terms = own_term(first, labels[0]), own_term(second, labels[1])
    shared = set(terms[0].sources) & set(terms[1].sources)
    if shared:
        raise ConfigError(
            f"{labels[1]}: stems from the same drive as {labels[0]}: what it says is not news. "
            "Compare calibrations of two drives"
        )
    if not set(first.lidars) & set(second.lidars):
        raise ConfigError(
            f"{labels[1]}: has none of the LiDARs of {labels[0]} ({', '.join(first.lidars)}), but "
            f"{', '.join(second.lidars)}. Give them the same names"
        )
    before, after = ({n: guess_of(c, n) for n in c.lidars} for c in (first, second))
    return compare_terms(terms, (before, after), first.reference, p_value)


def compare_terms(
    terms: tuple[DataTerm, DataTerm],
    guesses: tuple[Mapping[str, Guess], Mapping[str, Guess]],
    reference: str,
    p_value: float,
) -> Comparison:
    """`compare`, of what two sets of drives say.

    Args:
        terms: independent of each other.
        guesses: of each; they measure what counts as determined, and nothing else.
        reference: LiDAR that the others of a pair are taken against, if it belongs to the pair.
        p_value: see `compare`.
    """
    names, left_out = _comparable(terms)
    told = _told(terms[0], guesses[0], names), _told(terms[1], guesses[1], names)
    lidars = {name: _movement((name,), names, told) for name in names}
    pairs = tuple(_movement(pair, names, told) for pair in sensor_pairs(names, reference))
    tested = holm([*lidars.values(), *pairs], p_value)
    lidars = dict(zip(names, tested, strict=False))
    pairs = tuple(tested[len(names) :])
    chi2, dof, p = (0.0, 0, 1.0)
    if names:
        everything = np.concatenate(
            [vehicle_axes_difference(told[1].poses[n], told[0].poses[n]) for n in names]
        )
        identity = np.eye(len(everything))
        chi2, dof, p = _test(everything, [(identity, t) for t in told])
    return Comparison(
        lidars=lidars,
        pairs=pairs,
        chi2=chi2,
        dof=dof,
        p_value=p,
        moved=any(m.moved for m in tested),
        conclusion=_conclusion(lidars, pairs),
        not_compared=left_out,
        undetermined=(told[0].undetermined, told[1].undetermined),
    )


def holm(movements: Sequence[Movement], p_value: float) -> list[Movement]:
    """Corrects p-values for the number of tests (Holm 1979), and decides.

    Args:
        movements: those without degrees of freedom are no tests.
        p_value: chance of a false alarm over all of them.
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
    """LiDARs that both drives say anything about, and why the others are left out."""
    said = [
        {
            name: bool(np.any(np.diag(term.information)[6 * i : 6 * i + 6] > 0.0))
            for i, name in enumerate(term.T_vehicle_lidar)
        }
        for term in terms
    ]
    names, left_out = [], {}
    for name in dict.fromkeys([*said[0], *said[1]]):
        absent = [
            which for which, s in zip(("first", "second"), said, strict=True) if name not in s
        ]
        blind = [
            which
            for which, s in zip(("first", "second"), said, strict=True)
            if not s.get(name, True)
        ]
        if absent:
            left_out[name] = f"the {absent[0]} calibration does not have it"
        elif blind:
            left_out[name] = f"it saw no target in the {' and the '.join(blind)} calibration"
        else:
            names.append(name)
    return names, left_out


def _told(term: DataTerm, guesses: Mapping[str, Guess], names: Sequence[str]) -> _Told:
    """What a drive determines of some LiDARs by the rule of SPEC 4."""
    D, c = arranged(term, names)
    unit = scaling(len(names))
    # A trusted guess would leave nothing determined; here the question is what the data say.
    sigmas = [DEFAULT_GUESS_SIGMAS if guesses[n].fixed else guesses[n].sigmas for n in names]
    prior = np.diag(np.concatenate([*sigmas, np.zeros(0)]) ** -2.0)
    if not names:
        return _Told({}, np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0)), ())
    split = spectrum(D, prior)
    W, U = split.vectors[:, ~split.undetermined], split.vectors[:, split.undetermined]
    information = split.information[~split.undetermined]
    step = unit * (W @ ((W.T @ (unit * c)) / information))
    poses = {
        name: retract_vehicle_axes(term.T_vehicle_lidar[name], step[6 * i : 6 * i + 6])
        for i, name in enumerate(names)
    }
    leak = np.zeros((len(unit), 0))
    if U.shape[1]:
        certainty = U.T @ (prior * np.outer(unit, unit)) @ U
        leak = unit[:, None] * U @ np.linalg.inv(np.linalg.cholesky(certainty)).T
    return _Told(
        poses=poses,
        data=unit[:, None] * W / np.sqrt(information),
        leak=leak,
        lost=U,
        undetermined=tuple(d.text for d in named(assess(D, prior, poses), poses).undetermined),
    )


def _movement(lidars: tuple[str, ...], names: Sequence[str], told: tuple[_Told, _Told]) -> Movement:
    """The movement of a LiDAR against the vehicle, or of one against another."""
    before, after = told
    if len(lidars) == 1:
        (name,) = lidars
        movement = vehicle_axes_difference(after.poses[name], before.poses[name])
    else:
        # Where the first LiDAR would be, were the second where it was.
        source, to = lidars
        T_to_from = after.poses[to].between(after.poses[source])
        expected = before.poses[to].compose(T_to_from)
        movement = vehicle_axes_difference(expected, before.poses[source])
    parts = [(_selection(lidars, names, t.poses), t) for t in told]
    chi2, dof, p_value = _test(movement, parts)
    variance = sum(
        (np.sum((J @ t.data) ** 2, axis=1) + np.sum((J @ t.leak) ** 2, axis=1) for J, t in parts),
        start=np.zeros(6),
    )
    lost = np.any([_lost_axes(J, t) for J, t in parts], axis=0)
    sigma = np.sqrt(variance)
    p_axes = np.where(lost, 1.0, 2.0 * ndtr(-np.abs(movement) / sigma))
    return Movement(
        lidars=lidars,
        movement=movement,
        sigma=sigma,
        told=tuple(not bool(axis) for axis in lost),
        chi2=chi2,
        dof=dof,
        p_value=p_value,
        p_axes=p_axes,
    )


def _selection(
    lidars: tuple[str, ...], names: Sequence[str], poses: Mapping[str, gtsam.Pose3]
) -> Array:
    """(6, 6n) how a movement follows from those of all LiDARs, vehicle axes."""
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


def _lost_axes(J: Array, told: _Told) -> Array:
    """(6,) bool: axes that the undetermined directions reach, by the rule of SPEC 4."""
    if not told.lost.shape[1]:
        return np.zeros(6, dtype=bool)
    unit = scaling(J.shape[1] // 6)
    share = np.sum(((J * unit / UNIT[:, None]) @ told.lost) ** 2, axis=1)
    total = float(share.sum())
    return np.asarray((share > AXIS_SHARE * total) & (total > LIDAR_SHARE))


def _test(difference: Array, parts: Sequence[tuple[Array, _Told]]) -> tuple[float, int, float]:
    """Chi-square of a difference along the directions that both drives determine.

    Args:
        difference: (k,), vehicle axes.
        parts: per drive, the (k, 6n) derivative of the difference by its extrinsics.

    Returns:
        Chi-square, degrees of freedom, p-value.
    """
    unit = scaling(len(difference) // 6)
    data, leak = (
        sum(
            (_squared(J @ root / unit[:, None]) for J, root in roots),
            start=np.zeros((len(unit),) * 2),
        )
        for roots in ([(J, t.data) for J, t in parts], [(J, t.leak) for J, t in parts])
    )
    values, vectors = np.linalg.eigh(data + leak)
    whiten = vectors[:, values > 0.0] / np.sqrt(values[values > 0.0])
    # Between 0, where the data of both tell all, and 1, where those of one tell nothing.
    share, turn = np.linalg.eigh(whiten.T @ leak @ whiten)
    whitened = (whiten @ turn[:, share < _LEAK_SHARE]).T @ (difference / unit)
    dof = len(whitened)
    chi2 = float(whitened @ whitened)
    return chi2, dof, float(chdtrc(dof, chi2)) if dof else 1.0


def _squared(root: Array) -> Array:
    return np.asarray(root @ root.T)


def _conclusion(lidars: Mapping[str, Movement], pairs: Sequence[Movement]) -> str:
    """The verdict in words."""
    movements = [*lidars.values(), *pairs]
    if not any(m.dof for m in movements):
        return "Nothing can be said: there is no direction that both drives determine."
    moved = [name for name, m in lidars.items() if m.moved]
    apart = [m.lidars for m in pairs if m.moved]
    if not moved and not apart:
        return "No mount has moved, as far as these drives can tell."
    if not moved:
        said = ", ".join(f"'{a}' against '{b}'" for a, b in apart)
        return f"A mount has moved: {said}. Which of the two, the drives do not tell."
    if len(moved) == len(lidars) > 1 and not apart:
        return (
            "All LiDARs have moved together against the vehicle frame: what carries them, or the "
            "frame itself (IMU, GNSS antenna)."
        )
    verb = "has" if len(moved) == 1 else "have"
    kind = "LiDAR" if len(moved) == 1 else "LiDARs"
    return f"{kind} {', '.join(repr(name) for name in moved)} {verb} moved."
