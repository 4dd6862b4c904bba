"""Merges calibrations of one vehicle: the data of every drive count once, the guesses once."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

import caliv_graph
from caliv_graph.calibration.assemble import DRIVES, MOTION
from caliv_graph.config.guesses import with_found_guess, with_guess
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.compare import ALPHA, Comparison, compare_terms
from caliv_graph.fusion.marks import are_one, marked_drives
from caliv_graph.fusion.terms import Fused, brought_to, fuse, guess_of, own_term
from caliv_graph.geometry.se3 import joint_right_to_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Calibration, DataTerm, Guess, LidarResult
from caliv_graph.uncertainty.assemble import determined_axes
from caliv_graph.uncertainty.observability import assess, unguessed
from caliv_graph.wording.directions import named
from caliv_graph.wording.remedies import evidence_of

_SAME_GUESS = 1e-6
"""Largest difference of two equal guesses that were rounded, rad and m."""

_MERGED, _PRIOR = "merged", "prior"
"""Keys of the provenance: those of the parts of a result, and that of its `--prior`."""

_OF_PRIOR = "--prior: "
"""Begins the contradictions and warnings of an earlier calibration."""

_CONFLICT = "--prior and this drive disagree: "
"""Begins the warning of a mount that has moved. It is about the two that are calibrated then."""


@dataclass(frozen=True)
class Merger:
    """A merged calibration, and whether its parts agree.

    Attributes:
        calibration: the result; `status: inconsistent` if they do not agree.
        agreement: per label, that calibration against all others together. For two calibrations,
            only the second is listed, because the test is symmetric.
        warnings: warnings for the user, one line each.
    """

    calibration: Calibration
    agreement: Mapping[str, Comparison]
    warnings: tuple[str, ...]


def merge(calibrations: Mapping[str, Calibration], p_value: float = ALPHA) -> Merger:
    """Merges several calibrations of one vehicle.

    The information matrices of the data are summed at common extrinsics. The guess of a LiDAR
    counts once: that of the first file to which it was given. Earlier calibrations that were
    priors are included, each once.

    Args:
        calibrations: two or more, by their names in messages (their files).
        p_value: probability that calibrations of unchanged mounts are reported to disagree.

    Raises:
        ConfigError: two of them come from the same drive.
    """
    first = next(iter(calibrations.values()))
    own = {label: own_term(c, label) for label, c in calibrations.items()}
    terms = _every_drive_once(own, calibrations)
    _check_copies(calibrations)
    guesses = _first_guesses(calibrations)
    agreement = _agreement(own, terms, guesses, first.reference, p_value)
    modes = {c.provenance.get("mode") for c in calibrations.values()}
    mode = "joint" if modes == {"joint"} else "auto"
    fused = fuse(terms, guesses, mode)
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
        _MERGED: [dict(c.provenance) for c in calibrations.values()],
        DRIVES: list(data.sources),
    }
    contradictions = tuple(
        dict.fromkeys(t for c in calibrations.values() for t in c.contradictions)
    )
    draft = replace(
        first,
        provenance=provenance,
        unmet=(),
        earlier=(),
        contradictions=contradictions,
        suspects=(),
        vehicle={},
        structure=None,
    )
    results = _together_per_lidar(calibrations, guesses)
    calibration = _assembled(draft, results, guesses, fused, data, disagree)
    warnings = [
        *_disagreements(agreement, len(calibrations)),
        *(
            f"{label}: is inconsistent, so the merged calibration is inconsistent too"
            for label, c in calibrations.items()
            if c.status == "inconsistent"
        ),
        *_differing_guesses(calibrations, calibration),
    ]
    before = (said for c in calibrations.values() for said in _handed_on(c.warnings))
    calibration = replace(calibration, warnings=tuple(dict.fromkeys([*before, *warnings])))
    return Merger(calibration, agreement, tuple(warnings))


def _together_per_lidar(
    calibrations: Mapping[str, Calibration], names: Iterable[str]
) -> dict[str, LidarResult]:
    """Per LiDAR the first result, with the scans and time offsets of all calibrations."""
    out = {}
    for name in names:
        of_all = [c.lidars[name] for c in calibrations.values() if name in c.lidars]
        out[name] = replace(
            of_all[0],
            scans_used=sum(r.scans_used for r in of_all),
            saw_target=any(r.saw_target for r in of_all),
            saw_structure=any(r.saw_structure for r in of_all),
            time_offset=_mean_offset(of_all),
        )
    return out


def starting_from(
    config: Config,
    prior: Calibration,
    digests: Sequence[str],
    marks: Sequence[Sequence[str]] = (),
) -> Config:
    """The config with the extrinsics of an earlier calibration as initial guesses.

    Their sigmas stay those of the config, because a mount may have moved since.

    Args:
        config: the config.
        prior: the earlier calibration.
        digests: digests of the drives to calibrate.
        marks: of each of these drives (`marks.drive_marks`).

    Raises:
        ConfigError: the earlier calibration is of the same drive or has none of the LiDARs, or the
            mode is the paper's two stages, which cannot use earlier data.
    """
    if config.solve.mode == "staged":
        raise ConfigError(
            "--prior: solve.mode staged, the paper's procedure, cannot use an earlier calibration. "
            "Set solve.mode to auto or joint"
        )
    known = {source for term in prior_terms(prior) for source in term.sources}
    earlier = marked_drives(prior.provenance).values()
    again = any(are_one(frozenset(of), other) for of in marks for other in earlier)
    if again or known & set(digests):
        raise ConfigError(
            "--prior: is a result of the drive that is to be calibrated, which would count twice. "
            "Give a calibration of another drive"
        )
    common = [name for name in config.lidars if name in prior.lidars]
    if not common:
        raise ConfigError(
            f"--prior: has none of the LiDARs of the config ({', '.join(config.lidars)}), but "
            f"{', '.join(prior.lidars)}. Give them the same names"
        )
    for name in common:
        if not config.lidars[name].fixed:
            given = config.lidars[name].initial is not None
            start = with_guess if given else with_found_guess
            config = start(config, name, prior.lidars[name].T_vehicle_lidar)
    return config


def prior_terms(prior: Calibration) -> tuple[DataTerm, ...]:
    """Information of the data of an earlier calibration and of its own priors."""
    return (own_term(prior, "--prior"), *prior.earlier)


def with_earlier(
    calibration: Calibration, prior: Calibration, p_value: float = ALPHA
) -> tuple[Calibration, tuple[str, ...]]:
    """A calibration fused with the data of an earlier one.

    The reported data information stays that of the new drives. The extrinsics, their covariance and
    the verdicts are those of all data together.

    Args:
        calibration: of the new drives, solved by itself.
        prior: the earlier calibration, of other drives.
        p_value: probability that unchanged mounts are reported to have moved.

    Returns:
        The calibration, and warnings. It is `inconsistent` if a mount has moved since, or if one of
        the two is; it has the contradictions and warnings of both.
    """
    own = own_term(calibration, "this drive")
    terms = prior_terms(prior)
    # What the new drive found is no guess: then that of the earlier file is the one.
    stated = _first_guesses({"this drive": calibration, "--prior": prior})
    guesses = {
        name: stated[name] if lidar.guess is None or lidar.guess.found else lidar.guess
        for name, lidar in calibration.lidars.items()
    }
    before = _together(terms, {name: guess_of(prior, name) for name in prior.lidars} | guesses)
    comparison = compare_terms((before, own), (guesses, guesses), calibration.reference, p_value)
    mode = "joint" if calibration.provenance.get("mode") == "joint" else "auto"
    fused = fuse((*terms, own), guesses, mode)
    draft = replace(
        calibration,
        earlier=terms,
        contradictions=(*calibration.contradictions, *_as_of_prior(prior.contradictions)),
        warnings=(*calibration.warnings, *_as_of_prior(prior.warnings)),
        provenance={**calibration.provenance, _PRIOR: dict(prior.provenance)},
    )
    disagree = comparison.moved or "inconsistent" in (calibration.status, prior.status)
    data = brought_to(own, fused.T_vehicle_lidar, guesses)
    warnings = []
    if comparison.moved:
        warnings.append(
            f"{_CONFLICT}{_largest(comparison)}. {comparison.conclusion} The "
            "result mixes both: calibrate without --prior"
        )
    if prior.status == "inconsistent":
        warnings.append(
            "--prior: is inconsistent, so the result is inconsistent too: calibrate without --prior"
        )
    result = _assembled(draft, calibration.lidars, guesses, fused, data, disagree)
    return result, tuple(warnings)


def _as_of_prior(said: Sequence[str]) -> tuple[str, ...]:
    """Sentences of an earlier calibration, marked as such."""
    return tuple(f"{_OF_PRIOR}{one.removeprefix(_OF_PRIOR)}" for one in _handed_on(said))


def _handed_on(said: Sequence[str]) -> tuple[str, ...]:
    """Sentences of a calibration that are true of what is made of it, too."""
    return tuple(sentence for sentence in said if not sentence.startswith(_CONFLICT))


def _assembled(
    draft: Calibration,
    results: Mapping[str, LidarResult],
    guesses: Mapping[str, Guess],
    fused: Fused,
    data: DataTerm,
    disagree: bool,
) -> Calibration:
    """The reported result of a fusion, in right perturbations.

    Args:
        draft: a calibration with all fields that the fusion does not change.
        results: per LiDAR likewise.
        guesses: of all LiDARs together.
        fused: the estimate.
        data: information reported as that of the data, at the estimate.
        disagree: whether the fused calibrations disagree.
    """
    poses = fused.T_vehicle_lidar
    to_right = np.ascontiguousarray(joint_right_to_vehicle_axes(poses.values()).T)
    known = fused.information + fused.trusted
    cov = fused.cov + unguessed(known, [guesses[name] for name in poses])
    cov = to_right @ cov @ to_right.T
    information = to_right @ data.information @ to_right.T
    uncertainty = named(
        assess(known, fused.prior, poses),
        poses,
        evidence_of(results.values(), _without_motion_data(draft.provenance)),
    )
    lidars = {}
    for i, (name, result) in enumerate(results.items()):
        block = slice(6 * i, 6 * i + 6)
        guess = guesses[name]
        found = dict.fromkeys(AXES, False)
        if result.has_data or guess.fixed:
            found = dict(uncertainty.determined[name])
        lidars[name] = replace(
            result,
            T_vehicle_lidar=poses[name],
            cov=cov[block, block],
            determined=determined_axes(found, guess, poses[name], cov[block, block]),
            guess=guess,
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


def _without_motion_data(provenance: Mapping[str, object]) -> bool:
    """Whether the drives of a result, and those of its parts, recorded no motion at all."""
    parts = provenance.get(_MERGED)
    own = list(parts) if isinstance(parts, list | tuple) else []
    if not own and MOTION not in provenance:
        return False
    earlier = [provenance[_PRIOR]] if _PRIOR in provenance else []
    return all(
        isinstance(part, Mapping) and _without_motion_data(part) for part in [*own, *earlier]
    )


def _every_drive_once(
    own: Mapping[str, DataTerm], calibrations: Mapping[str, Calibration]
) -> list[DataTerm]:
    """Every calibration's own data, and the earlier data that it used as a prior.

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
                    f"{label}: was made with --prior, of whose drives one is also in "
                    f"{from_label[known[0]]} and would count twice. Merge the calibrations of the "
                    "single drives"
                )
            from_label |= dict.fromkeys(term.sources, f"{label} (--prior)")
            terms.append(term)
    return terms


def _check_copies(calibrations: Mapping[str, Calibration]) -> None:
    """Raises `ConfigError` if drives of two calibrations are copies or parts of one recording.

    A drive that both name by the same digest counts once already.
    """
    marked = {label: marked_drives(c.provenance) for label, c in calibrations.items()}
    for (one, of_one), (other, of_other) in itertools.combinations(marked.items(), 2):
        for digest, marks in of_one.items():
            for again, same in of_other.items():
                if digest != again and are_one(marks, same):
                    raise ConfigError(
                        f"{other}: stems from the same drive as {one}, as another copy or part of "
                        f"it: {len(marks & same)} of {min(len(marks), len(same))} messages that "
                        "were compared are the same. It would count twice. Leave one of them out"
                    )


def _first_guesses(calibrations: Mapping[str, Calibration]) -> dict[str, Guess]:
    """Per LiDAR the guess of the first calibration that states one, in order of appearance.

    A guess that was found in a drive stands back behind one that somebody gave, and that behind one
    that is trusted (`fixed: true`): it is a measurement.
    """
    out: dict[str, Guess] = {}
    for calibration in calibrations.values():
        for name in calibration.lidars:
            stated = [
                guess
                for c in calibrations.values()
                if name in c.lidars and (guess := c.lidars[name].guess) is not None
            ]
            if name not in out:
                fixed = [guess for guess in stated if guess.fixed]
                given = [guess for guess in stated if not guess.found]
                first = next(iter([*fixed, *given, *stated]), None)
                out[name] = first or guess_of(calibration, name)
    return out


def _together(terms: Sequence[DataTerm], guesses: Mapping[str, Guess]) -> DataTerm:
    """The information of several drives as one term."""
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
    """The most significant movement, in words."""
    movement = min(comparison.movements, key=lambda m: (m.p_corrected, -m.chi2))
    what = " against ".join(f"'{name}'" for name in movement.lidars)
    parts = []
    for unit, axes in (("mrad", AXES[:3]), ("mm", AXES[3:])):
        for axis in axes:
            i = AXES.index(axis)
            if movement.determined[i] and abs(movement.movement[i]) > 3.0 * movement.sigma[i]:
                value, sigma = 1e3 * movement.movement[i], 1e3 * movement.sigma[i]
                parts.append(f"{axis} {value:+.2f} +- {sigma:.2f} {unit}")
    return f"{what} by {', '.join(parts) or 'several axes together'} (p = {movement.p_value:.1g})"


def _mean_offset(results: Sequence[LidarResult]) -> tuple[float, float] | None:
    """Mean of the estimated time offsets, weighted by the inverse variances."""
    estimated = [r.time_offset for r in results if r.time_offset is not None]
    if not estimated:
        return None
    weights = np.array([sigma**-2.0 for _, sigma in estimated])
    mean = float(weights @ [value for value, _ in estimated] / weights.sum())
    return mean, float(weights.sum() ** -0.5)


def _differing_guesses(calibrations: Mapping[str, Calibration], merged: Calibration) -> list[str]:
    """A warning per file and LiDAR whose guess decides, where those of files differ.

    A guess decides undetermined axes, and a trusted one all.
    """
    out = []
    for name, lidar in merged.lidars.items():
        used = lidar.guess
        for label, calibration in calibrations.items():
            other = calibration.lidars[name].guess if name in calibration.lidars else None
            if used is None or other is None or other.found:
                continue  # nobody gave it
            apart = vehicle_axes_difference(other.T_vehicle_lidar, used.T_vehicle_lidar)
            if np.abs(apart).max() <= _SAME_GUESS:
                continue
            if used.fixed and other.fixed:
                out.append(
                    f"{label}: its fixed extrinsic of '{name}' is not used: it differs from that "
                    f"of an earlier file by {1e3 * np.linalg.norm(apart[3:]):.1f} mm and "
                    f"{np.degrees(np.linalg.norm(apart[:3])):.3f} degrees. Fix it at one place, or "
                    "remove 'fixed'"
                )
            elif merged.undetermined and not used.fixed and not all(lidar.determined.values()):
                out.append(
                    f"{label}: its initial guess of '{name}' is not used: it differs from that of "
                    "an earlier file, which decides the undetermined axes"
                )
    return out
