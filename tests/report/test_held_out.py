"""What pages, tables and JSON say of strips: of a calibration, and held out by a validation."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import Array, Strip, StructureTerm
from caliv_graph.report.figures.strips import strip_figure
from caliv_graph.report.surfaces import kind_of
from caliv_graph.report.validation import (
    render_validation,
    validation_document,
    validation_table,
)
from caliv_graph.validation.clouds import Clouds
from caliv_graph.validation.findings import (
    AFTER,
    BEFORE,
    STAGES,
    WITHOUT,
    HeldOutStructure,
    HeldOutTest,
    HeldStrip,
    Validation,
    Verdict,
    Word,
)
from caliv_graph.validation.verdict import with_held_out
from caliv_graph.wording.guesses import before_words
from tests.report.test_html import EVIL

PAIR = ("front", EVIL)


def held_strip(number: int, after_m: float, shared: bool = True) -> HeldStrip:
    apart = {BEFORE: 0.2, AFTER: after_m, WITHOUT: 0.001}
    return HeldStrip(
        name=f"strip {number}",
        surface=0,
        centre_map=np.array([10.0 + number, -4.0, 1.5]),
        normal_map=np.array([-1.0, 0.0, 0.0]),
        scans={"front": 9, EVIL: 7} if shared else {"front": 9},
        tested=shared,
        distance_m={stage: {PAIR: d} if shared else {} for stage, d in apart.items()},
        sigma_m={stage: {PAIR: 0.003} if shared else {} for stage in (AFTER, WITHOUT)},
        thickness_m={BEFORE: 0.1, AFTER: 0.002, WITHOUT: 0.002},
        expected_thickness_m={AFTER: 0.0025, WITHOUT: 0.0025},
    )


def held_out(after_m: float = 0.002, p: tuple[float, float] = (0.4, 0.5)) -> HeldOutStructure:
    tests = {
        stage: HeldOutTest(2.0, 2, p_value, 0.003)
        for stage, p_value in zip((AFTER, WITHOUT), p, strict=True)
    }
    return HeldOutStructure(
        tiles_map_m=np.array([[6.0, -6.0]]),
        tile_m=6.0,
        tiles_of=4,
        strips=(held_strip(1, after_m), held_strip(2, -after_m), held_strip(3, 0.0, shared=False)),
        tests=tests,
        distance_m={BEFORE: 0.2, AFTER: after_m, WITHOUT: 0.001},
    )


def verdict(p_value: float | None = 0.3) -> Verdict:
    word: Word = "unclear" if p_value is None else "good"
    return Verdict(word, 10.0, "distance", 0.9, 3.0, 3, p_value, False, ("Walls fit.",))


GUESSES = before_words(PAIR, ())


def validation(held: HeldOutStructure) -> Validation:
    nothing = np.zeros(0, dtype=np.int64)
    zero = dict.fromkeys(STAGES, 0.0)
    return Validation(
        drive="drive",
        lidars=PAIR,
        scans=dict.fromkeys(PAIR, 10),
        surfaces=(),
        things=(),
        pairs=(),
        thickness_m=zero,
        alone_m={stage: {} for stage in STAGES},
        expected_thickness_m=0.0,
        expected_alone_m={},
        verdict=with_held_out(verdict(None), held, GUESSES),
        clouds=Clouds(PAIR, nothing, nothing, {}, dict.fromkeys(PAIR, 10)),
        best=(),
        warnings=(),
        held_out=held,
    )


def test_the_page_and_the_json_name_every_held_out_strip() -> None:
    found = validation(held_out())
    page = render_validation(found, None, 0.001)
    assert f"<strong>{found.verdict.word}</strong>" in page.split("<table")[0]
    for number in (1, 2, 3):
        assert f"strip {number}" in page
    assert "wall that faces west" in page
    assert "<script>alert" not in page
    assert "figure-held-out-thickness" in page
    document = json.loads(json.dumps(validation_document(found, None, 0.001)))["held_out"]
    assert (document["tiles"], document["of_tiles"]) == (1, 4)
    first, _, last = document["strips"]
    assert first["xyz_map_m"] == [11.0, -4.0, 1.5]
    assert first["pairs"][0]["distance_m"] == {BEFORE: 0.2, AFTER: 0.002, WITHOUT: 0.001}
    assert (last["tested"], last["pairs"]) == (False, [])
    validation_table(found, None, 0.001)


def test_what_was_found_in_the_drive_is_not_called_a_guess() -> None:
    """Of a LiDAR for which nobody gave one."""
    words = before_words(PAIR, PAIR)
    found = replace(validation(held_out()), before=words)
    found = replace(found, verdict=with_held_out(verdict(None), held_out(), words))

    page = render_validation(found, None, 0.001)

    assert before_words(PAIR, PAIR[:1]) == (
        f"the initial guesses, and what was found in the drive for {PAIR[0]}"
    )
    assert f"before: with {words}." in page
    assert f"mm with {words} (root mean square)" in page
    # How the calibration without the strips is begun stands in another sentence.
    assert page.count("initial guess") == page.count("solved from the initial guesses")


@pytest.mark.parametrize(
    ("after_m", "p", "walls", "word"),
    [
        (0.002, (0.4, 0.5), 0.3, "good"),
        (0.002, (0.4, 0.5), None, "good"),
        (0.002, (1e-3, 0.5), 0.3, "unclear"),
        (0.002, (1e-9, 0.5), 0.3, "contradicted"),
        (0.002, (0.4, 1e-9), 0.3, "contradicted"),
        (0.4, (1e-9, 0.5), 0.3, "worse"),
    ],
)
def test_the_worse_word_counts(
    after_m: float, p: tuple[float, float], walls: float | None, word: str
) -> None:
    found = with_held_out(verdict(walls), held_out(after_m, p), GUESSES)
    assert found.word == word
    assert found.contradicts == (min(p) < 1e-7)
    assert ("do not explain" in found.reason) == found.contradicts


@pytest.mark.parametrize(
    ("wall", "walls", "p", "word"),
    [
        (False, None, 0.4, "unclear"),
        (True, None, 0.4, "good"),
        (False, 0.3, 0.4, "good"),  # these tell x, y and yaw
        (False, None, 1e-9, "contradicted"),
    ],
)
def test_level_strips_alone_make_nothing_good(
    wall: bool, walls: float | None, p: float, word: str
) -> None:
    held, up = held_out(p=(p, 0.5)), np.array([0.0, 0.0, 1.0])
    first, second, unshared = held.strips
    second = second if wall else replace(second, normal_map=up)
    strips = (replace(first, normal_map=up), second, unshared)
    found = with_held_out(verdict(walls), replace(held, strips=strips), GUESSES)
    assert found.word == word
    assert found.only_level == (word == "unclear")


def test_strips_that_no_two_lidars_see_change_no_verdict() -> None:
    held = replace(held_out(), strips=(held_strip(1, 0.0, shared=False),))
    found = with_held_out(verdict(), held, GUESSES)
    assert (found.word, found.contradicts) == ("good", False)
    assert "tests nothing" in found.sentences[-1]


def test_strips_are_drawn_where_they_are_and_coloured_by_lidar() -> None:
    normal = np.array([0.0, 1.0, 0.0])
    seen = {"front": 0.002, EVIL: -0.001}
    strips = [strip(np.array([2.0 * i, 5.0, 1.0]), normal, seen) for i in range(3)]
    strips.append(strip(np.array([99.0, 0.0, 0.0]), normal, {"front": 0.0}, weight=0.0))
    term = StructureTerm(
        drive=0,
        stamps_ns=np.zeros(0, np.int64),
        T_map_vehicle=(),
        parameters={},
        time_offsets_s={},
        T_vehicle_lidar=dict.fromkeys(PAIR),  # type: ignore[arg-type]
        information=np.zeros((0, 0)),
        gradient=np.zeros(0),
        strips=tuple(strips),
        offset_m=0.001,
    )
    figure = strip_figure(term, EVIL)
    assert figure is not None
    thickness, front, other = figure.figure.data
    assert [thickness["visible"], front["visible"], other["visible"]] == [True, False, False]
    assert np.ptp(thickness["x"]) == pytest.approx(4.0 + 1.6)  # the dropped one is not drawn
    assert np.ptp(thickness["y"]) == pytest.approx(0.0, abs=1e-6)
    assert list(front["intensity"]) == pytest.approx([2.0] * 6)
    assert list(other["intensity"]) == pytest.approx([-1.0] * 6)
    assert "<script>alert" not in figure.figure.json()


def strip(centre: Array, normal: Array, seen: dict[str, float], weight: float = 1.0) -> Strip:
    return Strip(
        drive=0,
        surface=0,
        centre_map=centre,
        normal_map=normal,
        scans=dict.fromkeys(seen, 8),
        residuals_m=seen,
        scatter_m=0.001,
        before_m=0.1,
        weight=weight,
    )


def test_a_surface_is_named_by_where_it_faces() -> None:
    assert kind_of(np.array([0.0, 0.0, 1.0])) == "ground"
    assert kind_of(np.array([0.0, -1.0, 0.1])) == "wall that faces south"
    assert kind_of(np.array([-0.7, 0.7, 0.0])) == "wall that faces north-west"
