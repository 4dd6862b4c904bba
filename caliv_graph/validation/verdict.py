"""The verdict of a validation: a chi-square test of the offsets, and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from caliv_graph.validation.findings import (
    AFTER,
    BEFORE,
    BEST,
    STAGES,
    WITHOUT,
    HeldOutStructure,
    Pair,
    PairResult,
    PairTest,
    SurfaceResult,
    ThingResult,
    Verdict,
    Word,
)
from caliv_graph.validation.measure import (
    POLE_TRUE_M,
    WALL_TRUE_M,
    Errors,
    offset_covariance,
    rms,
)
from caliv_graph.validation.surfaces import LEVEL
from caliv_graph.wording.halves import solved_anew_sentence
from caliv_graph.wording.held_out import (
    held_out_sentence,
    level_sentence,
    nothing_shared_sentence,
    stage_sentence,
    thick_sentence,
)

POOR = 0.01
"""Probability below which noise explains the offsets poorly."""

THICK = 2.0
"""Thickness of surfaces by a LiDAR alone over the expected one, from which no verdict is good: a
wrong rotation moves a surface from scan to scan, and hardly the mean distance from another LiDAR's.
"""

IRREGULAR = 2.0
"""The same of one surface at the best alignment, from which it tests nothing."""

CONTRADICTION = 5.7e-7
"""Probability beyond 5 sigma. Below it the data contradict each other, which is exit code 4."""


def is_shared(surface: SurfaceResult, pair: Pair) -> bool:
    """Whether the distance of two LiDARs on a surface is measurable at all stages."""
    stages = [surface.expected.distance_m, *surface.apart.values()]
    return all(pair in of_stage for of_stage in stages)


def is_irregular(surface: SurfaceResult, lidar: str) -> bool:
    """Whether what a LiDAR sees of a surface is far thicker than it is even at the best alignment.

    Corners of cars, leaves, the edge of something else: its distance says nothing of extrinsics.
    """
    return surface.thickness[BEST].alone[lidar] > IRREGULAR * surface.expected.alone[lidar]


def judge(
    surfaces: Sequence[SurfaceResult],
    things: Sequence[ThingResult],
    pairs: Sequence[PairResult],
    alone: tuple[Mapping[str, Mapping[str, float]], Mapping[str, float]],
    errors: Errors,
    before: str,
) -> Verdict:
    """The verdict on what was measured.

    `alone` has the thickness by stage and LiDAR, and its expected value by LiDAR; `before` says
    what a calibration is compared with.
    """
    tested = _tested(surfaces)
    chi2, p_value = 0.0, None
    dof = sum(len(s.apart[AFTER][pair].offset_m) for s, pair in tested)
    if tested:
        offsets = np.concatenate([s.apart[AFTER][pair].offset_m for s, pair in tested])
        cov = offset_covariance([(s.expected, pair) for s, pair in tested], errors)
        chi2 = max(float(offsets @ np.linalg.solve(cov, offsets)), 0.0)
        p_value = float(chdtrc(dof, chi2))
    shared = [pair for pair in pairs if pair.surfaces]
    measure = "distance" if shared else "thickness"
    if shared:
        values = {s: rms([p.distance_m[s] for p in shared]) for s in STAGES}
        expected = rms([p.expected_m for p in shared])
    else:
        values = {s: rms(list(alone[0][s].values())) for s in STAGES}
        expected = rms(list(alone[1].values()))
    found = bool(surfaces)
    better = values[BEFORE] / values[AFTER] if found and values[AFTER] > 0.0 else None
    of_expected = values[AFTER] / expected if found and expected > 0.0 else None
    contradicts = p_value is not None and p_value < CONTRADICTION
    sentences = _sentences(
        (values, expected, better, before),
        (chi2, dof, p_value, contradicts),
        (shared, surfaces, things),
    )
    if shared and better is not None:
        thick = ", ".join(
            f"'{name}' {1e3 * value:.1f} mm (expected {1e3 * alone[1][name]:.1f})"
            for name, value in alone[0][AFTER].items()
        )
        sentences += (f"Thickness of {_kinds(surfaces)} by each LiDAR alone: {thick}.",)
    word = _word(better, p_value)
    far = [name for name, value in alone[0][AFTER].items() if value > THICK * alone[1][name]]
    if found and far:
        sentences += (thick_sentence(_kinds(surfaces), far),)
        word = "unclear" if word == "good" else word
    reason = sentences[1] if contradicts else ""
    return Verdict(
        word, better, measure, of_expected, chi2, dof, p_value, contradicts, sentences, reason
    )


_SEVERITY: tuple[Word, ...] = ("good", "unclear", "contradicted", "worse")


def with_held_out(verdict: Verdict, held: HeldOutStructure, before: str) -> Verdict:
    """The verdict with the tests on held-out strips: the worse of the two words; and of S2S.

    Both the calibration in the file and the one without these strips are tested. Where walls and
    poles test nothing, the strips alone decide. `before` says what "before" is.
    """
    if not held.tested:
        return _with_pairs(verdict.also((nothing_shared_sentence(),)), held.pairs)
    values = {stage: 1e3 * held.distance_m[stage] for stage in (BEFORE, AFTER)}
    better = values[BEFORE] / values[AFTER] if values[AFTER] > 0.0 else None
    sentences = [held_out_sentence(len(held.tested), values[BEFORE], values[AFTER], before)]
    level = all(abs(strip.normal_map[2]) > LEVEL for strip in held.tested)
    if level:
        sentences.append(level_sentence())
    contradicting = []
    for stage in (AFTER, WITHOUT):
        test = held.tests[stage]
        assert test.p_value is not None
        words = "do not explain" if test.p_value < CONTRADICTION else "explain"
        if CONTRADICTION <= test.p_value < POOR:
            words = "explain poorly"
        distance, expected = 1e3 * held.distance_m[stage], 1e3 * test.expected_m
        tested = f"chi2 {test.chi2:.1f} of {test.dof} dof, p {test.p_value:.2g}"
        sentences.append(stage_sentence(stage == AFTER, distance, expected, words, tested))
        if test.p_value < CONTRADICTION:
            contradicting.append(sentences[-1])
    least = min(test.p_value or 0.0 for test in held.tests.values())
    words_of_both: list[Word] = [_word(better, least)]
    if verdict.p_value is not None:
        words_of_both.append(verdict.word)
    # Without walls, poles and objects there was nothing to say before.
    said = verdict.sentences if verdict.better is not None else ()
    word = max(words_of_both, key=_SEVERITY.index)
    only_level = level and verdict.p_value is None and word == "good"
    found = replace(
        verdict,
        word="unclear" if only_level else word,
        only_level=only_level,
        contradicts=verdict.contradicts or bool(contradicting),
        sentences=(*said, *sentences),
        reason=verdict.reason or next(iter(contradicting), ""),
    )
    return _with_pairs(found, held.pairs)


def _with_pairs(verdict: Verdict, pairs: Sequence[PairTest]) -> Verdict:
    """The verdict with the tests of S2S; of the pairs that agree, the one that does so least."""
    said: dict[bool, list[str]] = {True: [], False: []}
    for test in sorted((t for t in pairs if t.p_value is not None), key=lambda t: t.p_value or 0.0):
        assert test.p_value is not None
        p_value = min(1.0, test.p_value * len(pairs))
        tested = f"chi2 {test.chi2:.1f} of {test.dof} dof, p {p_value:.2g}"
        alike = p_value >= CONTRADICTION
        said[alike].append(solved_anew_sentence(test.worst, tested, alike))
    if said[False]:
        return verdict.also(said[False], contradicts=True)
    return verdict.also(said[True][:1])


def _word(better: float | None, p_value: float | None) -> Word:
    """The verdict in one word, of the gain over the guesses and the test of the offsets."""
    worse = better is not None and better < 1.0
    if p_value is None:
        return "unclear"
    if p_value < CONTRADICTION:
        return "worse" if worse else "contradicted"
    return "unclear" if worse or p_value < POOR else "good"


def _tested(surfaces: Sequence[SurfaceResult]) -> list[tuple[SurfaceResult, Pair]]:
    """Linearly independent offsets: of n LiDARs on a wall, n - 1."""
    out = []
    for surface in surfaces:
        pairs = [
            pair
            for pair in surface.apart[AFTER]
            if is_shared(surface, pair) and not any(is_irregular(surface, name) for name in pair)
        ]
        hub = max(surface.points, key=lambda name: surface.points[name])
        out += [(surface, pair) for pair in pairs if hub in pair]
    return out


def _sentences(
    measured: tuple[Mapping[str, float], float, float | None, str],
    test: tuple[float, int, float | None, bool],
    found: tuple[Sequence[PairResult], Sequence[SurfaceResult], Sequence[ThingResult]],
) -> tuple[str, ...]:
    values, expected, better, compared = measured
    shared, surfaces, things = found
    if not surfaces and not things:
        return (
            "Nothing can be said: there is no wall, pole or object near the drive except the "
            "target and the ground. Drive past a house, or put up a second target.",
        )
    if not surfaces or better is None:
        return (
            "There is no wall and no pole near the drive. The table has the distances of objects, "
            "but their expected values are not known.",
        )
    before, after, best = (f"{1e3 * values[stage]:.1f} mm" for stage in STAGES)
    kinds = _kinds(surfaces)
    how = f"{better:.1f} times better" if better >= 1.0 else f"{1.0 / better:.1f} times WORSE"
    what = (
        f"The distance between LiDARs on {kinds} is"
        if shared
        else f"No two LiDARs see the same surface. Each alone measures a thickness of {kinds} of"
    )
    out = [f"{what} {after} after calibration, {before} before: {how} than {compared}."]
    chi2, dof, p_value, contradicts = test
    ratio = values[AFTER] / expected
    remains = (
        "Noise, trajectory, the calibration's own sigmas and the shape of real walls and poles "
        f"({1e3 * WALL_TRUE_M:.0f} and {1e3 * POLE_TRUE_M:.0f} mm) give an expected value of "
        f"{1e3 * expected:.1f} mm; the measured value is {ratio:.1f} times that"
    )
    if p_value is None:
        out.append(f"{remains}.")
    else:
        tested = f"chi2 {chi2:.1f} of {dof} dof, p {p_value:.2g}"
        word = "They do not explain it" if contradicts else "They explain it"
        if not contradicts and p_value < POOR:
            word = "They explain it poorly"
        out.append(f"{remains}. {word} ({tested}).")
    out.append(f"Extrinsics fitted to this structure alone would leave {best}.")
    return tuple(out)


def _kinds(surfaces: Sequence[SurfaceResult]) -> str:
    """The kinds of surfaces that were found, in words."""
    words = {"wall": "walls", "pole": "poles", "ground": "planes of the ground"}
    found = dict.fromkeys(surface.name.split()[0] for surface in surfaces)
    return " and ".join(words[kind] for kind in found)
