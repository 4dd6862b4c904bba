"""The predicted covariance of recorded and planned drives, as tables and as plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from caliv_graph.common.json_text import without_infinities
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.report.layout import axis_headings, new_table, sentences, titled
from caliv_graph.report.numbers import SHOWN_AXES, rounded
from caliv_graph.report.tables import direction_texts
from caliv_graph.report.walls import (
    surveyed_wall_document,
    surveyed_wall_parts,
    wall_document,
    wall_parts,
)
from caliv_graph.results.calibration_file import calibration_document
from caliv_graph.scenario.beams import channel_elevations_deg
from caliv_graph.wording.guesses import in_brackets_sentence

if TYPE_CHECKING:
    from caliv_graph.planning.predict import Prediction
    from caliv_graph.planning.sightings import Sighting
    from caliv_graph.planning.suggest import Planned, Suggestion
    from caliv_graph.uncertainty.predicted import PredictedCovariance
    from caliv_graph.workflows.survey import Survey

LONGEST_PAUSE = 3.5
"""Periods of a LiDAR without a view of the target that end an interval of view."""


def survey_table(survey: Survey) -> RenderableType:
    """The result of `observability` as tables."""
    predicted = survey.covariance
    parts: list[RenderableType] = [
        Text.assemble(("Expected accuracy", "bold"), f": {', '.join(survey.names)}"),
        *_sigma_parts(predicted, "Expected"),
    ]
    if survey.scans:
        seen = new_table("target", "LiDAR", "scans\nused")
        for (target, lidar), count in survey.scans.items():
            seen.add_row(Text(target), Text(lidar), str(count))
        parts += titled("Scans that see the target", seen)
    parts += surveyed_wall_parts(survey)
    parts += _direction_parts(predicted)
    parts += sentences("Required by the config, but not expected to be reached:", survey.unmet)
    return Group(*parts)


def survey_document(survey: Survey) -> dict[str, Any]:
    """The result as plain values: metres, degrees, seconds."""
    return {
        "drives": list(survey.names),
        **_covariance_document(survey.covariance),
        "scans": [
            {"target": target, "lidar": lidar, "scans": count}
            for (target, lidar), count in survey.scans.items()
        ],
        **surveyed_wall_document(survey),
        "unmet": list(survey.unmet),
        "warnings": list(survey.warnings),
    }


def plan_table(
    planned: Planned, goals: Mapping[str, float], met: bool, suggestion: Suggestion | None
) -> RenderableType:
    """The result of `plan` as tables; `goals` has per limit the largest sigma allowed.

    The suggestion is the drive that keeps all limits in the least space, or comes nearest; None:
    none was found.
    """
    parts = [] if planned.prediction is None else _prediction_parts(planned.prediction)
    parts += _vehicle_parts(planned)
    if goals and planned.prediction is not None:
        kept = "keeps" if met else "does not keep"
        limits = ", ".join(f"{key} {value:g}" for key, value in goals.items())
        parts += ["", Text(f"The drive {kept} the limits: {limits}.")]
    parts += _suggestion_parts(planned, goals, met, suggestion)
    return Group(*parts)


def _prediction_parts(prediction: Prediction) -> list[RenderableType]:
    predicted = prediction.covariance
    x, y = prediction.space_m
    return [
        Text.assemble(
            ("Predicted accuracy", "bold"),
            f": {', '.join(prediction.names)}, {prediction.duration_s:.0f} s, {x:.0f} x {y:.0f} m",
        ),
        *_sigma_parts(predicted, "Predicted"),
        *_sighting_parts(prediction),
        *wall_parts(prediction),
        *_direction_parts(predicted),
    ]


def _vehicle_parts(planned: Planned) -> list[RenderableType]:
    """What a recording showed of its LiDARs."""
    if not planned.lidars:
        return []
    table = new_table("LiDAR", "azimuth\ndeg", "elevation\ndeg", "channels", "column\ndeg", "Hz")
    for name, model in planned.lidars.items():
        elevations = channel_elevations_deg(model)
        table.add_row(
            Text(name),
            "{:.0f} to {:.0f}".format(*model.horizontal_fov_deg),
            f"{elevations[0]:.1f} to {elevations[-1]:.1f}",
            str(len(elevations)),
            f"{model.horizontal_resolution_deg:.2f}",
            f"{model.rate_hz:.1f}",
        )
    return titled("LiDARs by their clouds: beams that returned", table)


def plan_document(
    planned: Planned, goals: Mapping[str, float], met: bool, suggestion: Suggestion | None
) -> dict[str, Any]:
    """The result as plain values: metres, degrees, seconds."""
    prediction = planned.prediction
    recorded = {name: m.model_dump(mode="json") for name, m in planned.lidars.items()}
    return {
        **({} if prediction is None else _prediction_document(prediction)),
        **({"recorded_lidars": recorded} if recorded else {}),
        "asked": dict(goals),
        "met": met,
        "suggestion": None if suggestion is None else _suggestion_document(suggestion),
        "warnings": [*planned.notes, *(() if prediction is None else prediction.warnings)],
    }


def _prediction_document(prediction: Prediction) -> dict[str, Any]:
    return {
        "drives": list(prediction.names),
        "duration_s": round(prediction.duration_s, 3),
        "space_m": [round(side, 2) for side in prediction.space_m],
        **_covariance_document(prediction.covariance),
        "sightings": [
            {"drive": drive, **_sighting_document(sighting)}
            for drive, sightings in zip(prediction.names, prediction.sightings, strict=True)
            for sighting in sightings
        ],
        **wall_document(prediction),
    }


def _suggestion_document(suggestion: Suggestion) -> dict[str, Any]:
    scenario = suggestion.scenario
    target = scenario.world.targets[0]
    place = scenario.world.objects[target]
    ramps = [ramp.model_dump(mode="json") for ramp in scenario.world.ground.ramps]
    return {
        "manoeuvre": suggestion.manoeuvre,
        "met": suggestion.met,
        "drive": scenario.drive.model_dump(mode="json"),
        "target": {"name": target, "xy_m": list(place.xy_m), "yaw_deg": place.yaw_deg},
        "ramps": ramps,
        "prediction": _prediction_document(suggestion.prediction),
    }


def _sighting_document(sighting: Sighting) -> dict[str, Any]:
    seen = len(sighting.stamps_ns)
    return {
        "lidar": sighting.lidar,
        "target": sighting.placement,
        "scans": seen,
        "scans_used": len(sighting.used),
        "seconds": [list(run) for run in _times(sighting)],
        "range_m": [round(float(r), 3) for r in (sighting.range_m.min(), sighting.range_m.max())]
        if seen
        else None,
        "points": [int(sighting.points.min()), int(sighting.points.max())] if seen else None,
    }


def _sighting_parts(prediction: Prediction) -> list[RenderableType]:
    if not any(prediction.sightings):
        return []
    return titled("When each LiDAR sees the target", _sightings(prediction))


def _sightings(prediction: Prediction) -> Table:
    several = len(prediction.names) > 1
    table = new_table(
        *(("drive",) if several else ()),
        "LiDAR",
        "target",
        "scans\nused / seen",
        "range\nm",
        "points\nper scan",
        "seconds",
    )
    for drive, sightings in zip(prediction.names, prediction.sightings, strict=True):
        for sighting in sightings:
            cells: list[Text | str] = [Text(drive)] if several else []
            cells += [Text(sighting.lidar), Text(sighting.placement)]
            cells.append(f"{len(sighting.used)} / {len(sighting.stamps_ns)}")
            if len(sighting.stamps_ns):
                r, n = sighting.range_m, sighting.points
                cells += [f"{r.min():.1f} to {r.max():.1f}", f"{n.min():.0f} to {n.max():.0f}"]
                cells.append(", ".join(f"{a:.1f} to {b:.1f}" for a, b in _times(sighting)))
            else:
                cells += ["-", "-", "never"]
            table.add_row(*cells)
    return table


def _times(sighting: Sighting) -> list[tuple[float, float]]:
    """First and last second of each interval in which the target is in view."""
    stamps: IntArray = sighting.stamps_ns
    if not len(stamps):
        return []
    steps = np.diff(stamps)
    period = float(np.median(steps)) if len(steps) else 0.0
    cuts = np.flatnonzero(steps > LONGEST_PAUSE * period)
    first = np.concatenate([[0], cuts + 1])
    last = np.concatenate([cuts, [len(stamps) - 1]])
    seconds = [round(float(stamp / NANOSECONDS_PER_SECOND), 3) for stamp in stamps]
    return [(seconds[a], seconds[b]) for a, b in zip(first.tolist(), last.tolist(), strict=True)]


def _suggestion_parts(
    planned: Planned, goals: Mapping[str, float], met: bool, suggestion: Suggestion | None
) -> list[RenderableType]:
    if suggestion is None:
        return []
    x, y = suggestion.space_m
    prediction = planned.prediction
    used = math.inf if prediction is None else prediction.space_m[0] * prediction.space_m[1]
    if met and not (suggestion.met and x * y < 0.95 * used):
        return []
    keeps = "keeps all limits" if goals else "determines all axes"
    beside = ", together with the recorded one," if planned.recorded and not met else ""
    heading = (
        f"Smallest drive that{beside} {keeps}:"
        if suggestion.met
        else f"None of the manoeuvres tried{beside} {keeps}. The nearest:"
    )
    lines: list[RenderableType] = [
        "",
        Text(heading, style="bold"),
        Text(f"  {suggestion.manoeuvre}; takes {x:.0f} x {y:.0f} m"),
    ]
    lines += [Text(f"  {key}: {_worst(suggestion.prediction, key)}") for key in goals]
    return lines


def _worst(prediction: Prediction, key: str) -> str:
    from caliv_graph.planning.predict import sigma_of

    found = sigma_of(prediction, key)
    if not found:
        return "no pair of LiDARs"
    return ", ".join(f"{value:.3g} of {what}" for what, value in found.items())


def _sigma_parts(predicted: PredictedCovariance, word: str) -> list[RenderableType]:
    """Tables of sigmas; those of undetermined axes in brackets."""
    extrinsics = new_table("LiDAR", *axis_headings("mm", "mrad"))
    verdicts = {name: r.determined for name, r in predicted.calibration.lidars.items()}
    for name, sigma in predicted.sigma_s2v.items():
        extrinsics.add_row(Text(name), *_sigma_cells(sigma, verdicts[name]))
    parts = titled(f"{word} 1 sigma of each extrinsic, vehicle axes", extrinsics)
    if predicted.sigma_s2s:
        pairs = new_table("from\nto", *axis_headings("mm", "mrad"))
        for (a, b), sigma in predicted.sigma_s2s.items():
            cells = _sigma_cells(sigma, predicted.determined_s2s[a, b])
            pairs.add_row(Text(f"{a}\n{b}"), *cells)
        parts += titled(f"{word} 1 sigma of one LiDAR against another, vehicle axes", pairs)
    held = [name for name, verdict in verdicts.items() if not all(verdict.values())]
    found = [name for name in held if predicted.calibration.lidars[name].without_guess]
    if held:
        parts.append(Text(in_brackets_sentence(held, found), style="yellow"))
    offsets = [f"LiDAR '{n}': {1e3 * s:.2f} ms" for n, s in predicted.offsets_s.items()]
    parts += sentences(f"{word} 1 sigma of the clocks:", offsets)
    return parts


def _sigma_cells(sigma: Array, determined: Mapping[str, bool]) -> list[Text]:
    values = dict(zip(AXES, 1e3 * sigma, strict=True))
    cells = []
    for axis in SHOWN_AXES:
        text = _three_digits(float(values[axis]))
        cells.append(Text(text) if determined[axis] else Text(f"({text})", style="yellow"))
    return cells


def _three_digits(value: float) -> str:
    """A positive number to two or three digits, without an exponent."""
    decimals = min(max(1 - math.floor(math.log10(max(value, 1e-6))), 0), 3)
    return f"{value:.{decimals}f}"


def _direction_parts(predicted: PredictedCovariance) -> list[RenderableType]:
    lost: Sequence[str] = [
        *direction_texts(predicted.undetermined),
        *(
            f"LiDAR '{name}' never sees a target or a wall: its extrinsic is not determined"
            for name in predicted.unseeing
        ),
    ]
    parts = sentences("Not determined by the drive:", lost)
    parts += sentences("Weakly determined:", direction_texts(predicted.weak))
    if not lost:
        parts += ["", Text("The drive determines all directions.", style="bold green")]
    scaled = ", ".join(_three_digits(s) if s < 1e4 else "none" for s in _spectrum(predicted))
    parts += ["", Text(f"Spectrum (1 sigma of the data, 1 mrad counted as 10 mm): {scaled}")]
    return parts


def _spectrum(predicted: PredictedCovariance) -> list[float]:
    return [float(s) for s in predicted.uncertainty.spectrum]


def _covariance_document(predicted: PredictedCovariance) -> dict[str, Any]:
    content = calibration_document(predicted.calibration)
    lidars = {
        name: {
            "sigma_vehicle_axes": _sigma_document(sigma),
            "determined": content["lidars"][name]["determined"],
            "sees_target": predicted.calibration.lidars[name].saw_target,
            **(
                {"time_offset": {"sigma": predicted.offsets_s[name]}}
                if name in predicted.offsets_s
                else {}
            ),
        }
        for name, sigma in predicted.sigma_s2v.items()
    }
    pairs = [
        {
            "from": a,
            "to": b,
            "sigma_vehicle_axes": _sigma_document(sigma),
            "determined": dict(predicted.determined_s2s[a, b]),
        }
        for (a, b), sigma in predicted.sigma_s2s.items()
    ]
    document = {
        "status": content["status"],
        "reference": content["reference"],
        "lidars": lidars,
        "sensor_to_sensor": pairs,
        "observability": {
            **content["observability"],
            "spectrum": [rounded(s) for s in _spectrum(predicted)],
        },
    }
    plain: dict[str, Any] = without_infinities(document)
    return plain


def _sigma_document(sigma: Array) -> dict[str, list[float]]:
    return {
        "rpy_deg": [rounded(v) for v in np.degrees(sigma[:3])],
        "xyz": [rounded(v) for v in sigma[3:]],
    }
