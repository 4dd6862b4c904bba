"""Several calibrations of one vehicle into one: the data of every drive once, the guesses once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

import caliv_graph
from caliv_graph.calibration.assemble import DRIVES
from caliv_graph.config.model import Config, PoseConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.compare import ALPHA, Comparison, compare_terms
from caliv_graph.fusion.terms import Fused, fuse, guess_of, moved_to, own_term
from caliv_graph.geometry.se3 import right_to_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Calibration, DataTerm, Guess, LidarResult
from caliv_graph.uncertainty.observability import assess
from caliv_graph.wording.directions import named

_SAME_GUESS = 1e-6
"""rad and m: up to here two guesses are the same one, rounded."""


@dataclass(frozen=True)
class Merger:
    """A merged calibration, and whether its parts agree.

    Attributes:
        calibration: the result; `status: inconsistent` if they do not.
        agreement: per label, that calibration against the others together. Of two it is the same
            either way, and only the second stands here.
        warnings: what a person should know, a line each.
    """

    calibration: Calibration
    agreement: Mapping[str, Comparison]
    warnings: tuple[str, ...]


def merge(calibrations: Mapping[str, Calibration], p_value: float = ALPHA) -> Merger:
    """Several calibrations of one vehicle into one.

    The informations of the data are summed at common extrinsics; the guesses, which the
    calibrations share, count once: that of a LiDAR is the first file's that has it. Earlier
    calibrations that served as priors are taken along, each once.

    Args:
        calibrations: two or more, by what to call them in messages (their files).
        p_value: chance that calibrations of mounts that stayed are said to disagree.

    Raises:
        ConfigError: two of them stem from the same drive.
    """
    first = next(iter(calibrations.values()))
    own = {label: own_term(c, label) for label, c in calibrations.items()}
    terms = _every_drive_once(own, calibrations)
    guesses = _first_guesses(calibrations)
    agreement = _agreement(own, terms, guesses, first.reference, p_value)
    modes = {c.provenance.get("mode") for c in calibrations.values()}
    mode = "joint" if modes == {"joint"} else "auto"
    fused = fuse(terms, guesses, mode)
    results = {}
    for name in guesses:
        of_all = [c.lidars[name] for c in calibrations.values() if name in c.lidars]
        results[name] = replace(
            of_all[0],
            scans_used=sum(r.scans_used for r in of_all),
            saw_target=any(r.saw_target for r in of_all),
            time_offset=_mean_offset(of_all),
            guess=guesses[name],
        )
    disagree = any(comparison.moved for comparison in agreement.values()) or any(
        c.status == "inconsistent" for c in calibrations.values()
    )
    data = DataTerm(
        tuple(dict.fromkeys(source for term in terms for source in term.sources)),
        fused.T_vehicle_lidar,
        fused.information,
        fused.gradient,
    )
    provenance: dict[str, object] = {
        "caliv_graph": caliv_graph.__version__,
        "mode": mode,
        "merged": [dict(c.provenance) for c in calibrations.values()],
        DRIVES: list(data.sources),
    }
    contradictions = tuple(
        dict.fromkeys(t for c in calibrations.values() for t in c.contradictions)
    )
    draft = replace(
        first, provenance=provenance, unmet=(), earlier=(), contradictions=contradictions
    )
    calibration = _assembled(draft, results, fused, data, disagree)
    warnings = [
        *_disagreements(agreement, len(calibrations)),
        *(
            f"{label}: is inconsistent in itself, and so is what is merged from it"
            for label, c in calibrations.items()
            if c.status == "inconsistent"
        ),
        *_differing_guesses(calibrations, calibration),
    ]
    return Merger(calibration, agreement, tuple(warnings))


def starting_from(config: Config, prior: Calibration, digests: Sequence[str]) -> Config:
    """The config with the extrinsics of an earlier calibration for initial guesses.

    How far off they may be stays as the config has it: a mount may have moved since.

    Args:
        config: the config.
        prior: the earlier calibration.
        digests: of the drives that are to be calibrated from.

    Raises:
        ConfigError: the earlier one is of the same drive or has none of the LiDARs, or the config
            asks for the paper's two stages, which know no earlier data.
    """
    if config.solve.mode == "staged":
        raise ConfigError(
            "--prior: solve.mode staged, the paper's procedure, knows no earlier calibration. Set "
            "solve.mode to auto or joint"
        )
    known = {source for term in prior_terms(prior) for source in term.sources}
    if known & set(digests):
        raise ConfigError(
            "--prior: is a result of the drive that is to be calibrated from, which would count "
            "twice. Give a calibration of another drive"
        )
    common = [name for name in config.lidars if name in prior.lidars]
    if not common:
        raise ConfigError(
            f"--prior: has none of the LiDARs of the config ({', '.join(config.lidars)}), but "
            f"{', '.join(prior.lidars)}. Give them the same names"
        )
    lidars = dict(config.lidars)
    for name in common:
        if not lidars[name].fixed:
            T = prior.lidars[name].T_vehicle_lidar
            x, y, z = (float(v) for v in T.translation())
            roll, pitch, yaw = (float(v) for v in np.degrees(T.rotation().rpy()))
            initial = PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))
            lidars[name] = lidars[name].model_copy(update={"initial": initial})
    return config.model_copy(update={"lidars": lidars})


def prior_terms(prior: Calibration) -> tuple[DataTerm, ...]:
    """What an earlier calibration, and those that it was made with, say."""
    return (own_term(prior, "--prior"), *prior.earlier)


def with_earlier(
    calibration: Calibration, prior: Calibration, p_value: float = ALPHA
) -> tuple[Calibration, tuple[str, ...]]:
    """A calibration together with what the data of an earlier one say.

    Its own data's information stays its own; the extrinsics, their covariance and the verdicts
    become those of all data together.

    Args:
        calibration: from new drives, solved by itself.
        prior: the earlier one, of other drives.
        p_value: chance that mounts that stayed are said to have moved.

    Returns:
        The calibration, `inconsistent` if a mount has moved since, and what a person should know.
    """
    own = own_term(calibration, "this drive")
    terms = prior_terms(prior)
    guesses = {name: guess_of(calibration, name) for name in calibration.lidars}
    before = _together(terms, {name: guess_of(prior, name) for name in prior.lidars} | guesses)
    comparison = compare_terms((before, own), (guesses, guesses), calibration.reference, p_value)
    mode = "joint" if calibration.provenance.get("mode") == "joint" else "auto"
    fused = fuse((*terms, own), guesses, mode)
    results = {
        name: replace(lidar, guess=guesses[name]) for name, lidar in calibration.lidars.items()
    }
    draft = replace(
        calibration,
        earlier=terms,
        provenance={**calibration.provenance, "prior": dict(prior.provenance)},
    )
    disagree = comparison.moved or calibration.status == "inconsistent"
    data = moved_to(own, fused.T_vehicle_lidar)
    warnings = [
        f"--prior and this drive disagree: {_largest(comparison)}. {comparison.conclusion} The "
        "result mixes both: calibrate without --prior"
    ]
    return _assembled(draft, results, fused, data, disagree), tuple(
        warnings if comparison.moved else ()
    )


def _assembled(
    draft: Calibration,
    results: Mapping[str, LidarResult],
    fused: Fused,
    data: DataTerm,
    disagree: bool,
) -> Calibration:
    """The reported result of a fusion, in right perturbations.

    Args:
        draft: what the fusion leaves alone.
        results: per LiDAR likewise.
        fused: the estimate.
        data: what is reported as the data's own information, at the estimate.
        disagree: whether what was fused does.
    """
    poses = fused.T_vehicle_lidar
    size = 6 * len(poses)
    to_right = np.zeros((size, size))
    for i, T in enumerate(poses.values()):
        block = slice(6 * i, 6 * i + 6)
        to_right[block, block] = right_to_vehicle_axes(T).T
    cov = to_right @ fused.cov @ to_right.T
    information = to_right @ data.information @ to_right.T
    uncertainty = named(assess(fused.information + fused.trusted, fused.prior, poses), poses)
    lidars = {}
    for i, (name, result) in enumerate(results.items()):
        block = slice(6 * i, 6 * i + 6)
        fixed = result.guess is not None and result.guess.fixed
        lidars[name] = replace(
            result,
            T_vehicle_lidar=poses[name],
            cov=cov[block, block],
            determined=dict(uncertainty.determined[name])
            if result.saw_target or fixed
            else dict.fromkeys(AXES, False),
        )
    complete = not uncertainty.undetermined and all(
        all(lidar.determined.values()) for lidar in lidars.values()
    )
    return replace(
        draft,
        status="inconsistent" if disagree else "ok" if complete else "partial",
        lidars=lidars,
        cov_joint=0.5 * (cov + cov.T),
        information_data=0.5 * (information + information.T),
        gradient_data=to_right @ data.gradient,
        undetermined=uncertainty.undetermined,
        weak=uncertainty.weak,
    )


def _every_drive_once(
    own: Mapping[str, DataTerm], calibrations: Mapping[str, Calibration]
) -> list[DataTerm]:
    """Every calibration's own data, and the earlier data that they came with.

    Raises:
        ConfigError: a drive would count twice.
    """
    terms: list[DataTerm] = []
    from_label: dict[str, str] = {}
    for label, term in own.items():
        for source in term.sources:
            if source in from_label:
                raise ConfigError(
                    f"{label}: stems from the same drive as {from_label[source]}, which would "
                    "count twice. Leave one of them out"
                )
            from_label[source] = label
        terms.append(term)
    for label, calibration in calibrations.items():
        for term in calibration.earlier:
            known = [source for source in term.sources if source in from_label]
            if len(known) == len(term.sources):
                continue
            if known:
                raise ConfigError(
                    f"{label}: was made with --prior, of whose drives one is in "
                    f"{from_label[known[0]]} too, and would count twice. Merge the calibrations "
                    "of the single drives"
                )
            from_label |= dict.fromkeys(term.sources, f"{label} (--prior)")
            terms.append(term)
    return terms


def _first_guesses(calibrations: Mapping[str, Calibration]) -> dict[str, Guess]:
    """Per LiDAR the guess of the first calibration that states one, in order of appearance."""
    out: dict[str, Guess] = {}
    for calibration in calibrations.values():
        for name in calibration.lidars:
            stated = [
                guess
                for c in calibrations.values()
                if name in c.lidars and (guess := c.lidars[name].guess) is not None
            ]
            if name not in out:
                out[name] = stated[0] if stated else guess_of(calibration, name)
    return out


def _together(terms: Sequence[DataTerm], guesses: Mapping[str, Guess]) -> DataTerm:
    """What several drives say, as one term."""
    if len(terms) == 1:
        return terms[0]
    names = {name for term in terms for name in term.T_vehicle_lidar}
    fused = fuse(terms, {name: guess for name, guess in guesses.items() if name in names})
    sources = tuple(dict.fromkeys(source for term in terms for source in term.sources))
    return DataTerm(sources, fused.T_vehicle_lidar, fused.information, fused.gradient)


def _agreement(
    own: Mapping[str, DataTerm],
    terms: Sequence[DataTerm],
    guesses: Mapping[str, Guess],
    reference: str,
    p_value: float,
) -> dict[str, Comparison]:
    """Every calibration against all other data together."""
    labels = list(own)[1:] if len(terms) == 2 else list(own)
    out = {}
    for label in labels:
        rest = _together([term for term in terms if term is not own[label]], guesses)
        if set(rest.T_vehicle_lidar) & set(own[label].T_vehicle_lidar):
            out[label] = compare_terms(
                (rest, own[label]), (guesses, guesses), reference, p_value / len(labels)
            )
    return out


def _disagreements(agreement: Mapping[str, Comparison], files: int) -> list[str]:
    others = "the other" if files == 2 else "the others"
    return [
        f"{label}: disagrees with {others}: {_largest(comparison)}"
        for label, comparison in agreement.items()
        if comparison.moved
    ]


def _largest(comparison: Comparison) -> str:
    """The most certain movement, in words."""
    movement = min(comparison.movements, key=lambda m: (m.p_corrected, -m.chi2))
    what = " against ".join(f"'{name}'" for name in movement.lidars)
    parts = []
    for unit, axes in (("mrad", AXES[:3]), ("mm", AXES[3:])):
        for axis in axes:
            i = AXES.index(axis)
            if movement.told[i] and abs(movement.movement[i]) > 3.0 * movement.sigma[i]:
                value, sigma = 1e3 * movement.movement[i], 1e3 * movement.sigma[i]
                parts.append(f"{axis} {value:+.2f} +- {sigma:.2f} {unit}")
    return f"{what} by {', '.join(parts) or 'several axes together'} (p = {movement.p_value:.1g})"


def _mean_offset(results: Sequence[LidarResult]) -> tuple[float, float] | None:
    """Mean of the estimated time offsets, weighed by their variances."""
    told = [r.time_offset for r in results if r.time_offset is not None]
    if not told:
        return None
    weights = np.array([sigma**-2.0 for _, sigma in told])
    mean = float(weights @ [value for value, _ in told] / weights.sum())
    return mean, float(weights.sum() ** -0.5)


def _differing_guesses(calibrations: Mapping[str, Calibration], merged: Calibration) -> list[str]:
    """A line where the guess matters, and the calibrations do not share it."""
    if not merged.undetermined:
        return []
    out = []
    for name, lidar in merged.lidars.items():
        used = lidar.guess
        for label, calibration in calibrations.items():
            other = calibration.lidars[name].guess if name in calibration.lidars else None
            if used is None or other is None or all(lidar.determined.values()):
                continue
            apart = vehicle_axes_difference(other.T_vehicle_lidar, used.T_vehicle_lidar)
            if np.abs(apart).max() > _SAME_GUESS:
                out.append(
                    f"{label}: its initial guess of '{name}' is another one than that which "
                    "decides here what no drive tells, and is not used"
                )
    return out
