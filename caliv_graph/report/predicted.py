"""What drives will tell, as tables and as JSON: of a recorded drive, and of a planned one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from caliv_graph.common.json_text import without_infinities
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.report.layout import SHOWN_AXES, axis_headings, new_table, sentences, titled
from caliv_graph.report.tables import direction_texts
from caliv_graph.results.calibration_file import calibration_document

if TYPE_CHECKING:
    from caliv_graph.planning.predict import Prediction
    from caliv_graph.planning.sightings import Sighting
    from caliv_graph.planning.suggest import Suggestion
    from caliv_graph.uncertainty.predicted import PredictedCovariance
    from caliv_graph.workflows.survey import Survey

LONGEST_PAUSE = 3.5
"""Periods of a LiDAR after which seeing the target again counts as another time."""


# ------------------------------------------------------------------ recorded


def survey_table(survey: Survey) -> RenderableType:
    """The closing words of `observability`."""
    outlook = survey.outlook
    parts: list[RenderableType] = [
        Text.assemble(("What the drive will tell", "bold"), f": {', '.join(survey.names)}"),
        *_sigma_parts(outlook, "Expected"),
    ]
    seen = new_table("target", "LiDAR", "scans\nthat count")
    for (target, lidar), count in survey.scans.items():
        seen.add_row(Text(target), Text(lidar), str(count))
    parts += titled("Who sees the target", seen)
    parts += _direction_parts(outlook)
    parts += sentences("Asked for in the config, but not to be had:", survey.unmet)
    return Group(*parts)


def survey_document(survey: Survey) -> dict[str, Any]:
    """The same as plain values: metres, degrees, seconds."""
    return {
        "drives": list(survey.names),
        **_outlook_document(survey.outlook),
        "scans": [
            {"target": target, "lidar": lidar, "scans": count}
            for (target, lidar), count in survey.scans.items()
        ],
        "unmet": list(survey.unmet),
        "warnings": list(survey.warnings),
    }


# ------------------------------------------------------------------ planned


def plan_table(
    prediction: Prediction, goals: Mapping[str, float], met: bool, suggestion: Suggestion | None
) -> RenderableType:
    """The closing words of `plan`.

    Args:
        prediction: of the planned drive.
        goals: largest sigmas that were asked for, by limit.
        met: whether it keeps them.
        suggestion: the drive that does in the least space, or comes nearest; None: there is none.
    """
    outlook = prediction.covariance
    x, y = prediction.space_m
    parts: list[RenderableType] = [
        Text.assemble(
            ("What this drive will tell", "bold"),
            f": {', '.join(prediction.names)}, {prediction.duration_s:.0f} s, {x:.0f} x {y:.0f} m",
        ),
        *_sigma_parts(outlook, "Predicted"),
        *titled("Who sees the target when", _sightings(prediction)),
        *_direction_parts(outlook),
    ]
    if goals:
        kept = "keeps" if met else "does not keep"
        asked = ", ".join(f"{key} {value:g}" for key, value in goals.items())
        parts += ["", Text(f"It {kept} what was asked for: {asked}.")]
    parts += _suggestion_parts(prediction, goals, met, suggestion)
    return Group(*parts)


def plan_document(
    prediction: Prediction, goals: Mapping[str, float], met: bool, suggestion: Suggestion | None
) -> dict[str, Any]:
    """The same as plain values: metres, degrees, seconds."""
    return {
        **_prediction_document(prediction),
        "asked": dict(goals),
        "met": met,
        "suggestion": None if suggestion is None else _suggestion_document(suggestion),
        "warnings": list(prediction.warnings),
    }


def _prediction_document(prediction: Prediction) -> dict[str, Any]:
    return {
        "drives": list(prediction.names),
        "duration_s": round(prediction.duration_s, 3),
        "space_m": [round(side, 2) for side in prediction.space_m],
        **_outlook_document(prediction.covariance),
        "sightings": [
            {"drive": drive, **_sighting_document(sighting)}
            for drive, sightings in zip(prediction.names, prediction.sightings, strict=True)
            for sighting in sightings
        ],
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
        "range_m": [_rounded(sighting.range_m.min()), _rounded(sighting.range_m.max())]
        if seen
        else None,
        "points": [int(sighting.points.min()), int(sighting.points.max())] if seen else None,
    }


def _rounded(value: float) -> float:
    return round(float(value), 3)


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
    """First and last second of each time that the target is in view."""
    stamps: IntArray = sighting.stamps_ns
    if not len(stamps):
        return []
    steps = np.diff(stamps)
    period = float(np.median(steps)) if len(steps) else 0.0
    cuts = np.flatnonzero(steps > LONGEST_PAUSE * period)
    first = np.concatenate([[0], cuts + 1])
    last = np.concatenate([cuts, [len(stamps) - 1]])
    return [
        (
            _rounded(stamps[a] / NANOSECONDS_PER_SECOND),
            _rounded(stamps[b] / NANOSECONDS_PER_SECOND),
        )
        for a, b in zip(first.tolist(), last.tolist(), strict=True)
    ]


def _suggestion_parts(
    prediction: Prediction, goals: Mapping[str, float], met: bool, suggestion: Suggestion | None
) -> list[RenderableType]:
    if suggestion is None:
        return []
    x, y = suggestion.prediction.space_m
    smaller = x * y < 0.95 * prediction.space_m[0] * prediction.space_m[1]
    if met and not (suggestion.met and smaller):
        return []
    wanted = "what was asked for" if goals else "everything"
    if suggestion.met:
        heading = f"In the least space{'' if met else ','} {wanted} is told by:"
    else:
        heading = f"None of the manoeuvres tried tells {wanted}. The nearest:"
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
        return "there is no pair of LiDARs"
    return ", ".join(f"{value:.3g} of {what}" for what, value in found.items())


# ------------------------------------------------------------------ both


def _sigma_parts(outlook: PredictedCovariance, word: str) -> list[RenderableType]:
    """Tables of sigmas; what is held by the guess in brackets."""
    extrinsics = new_table("LiDAR", *axis_headings("mm", "mrad"))
    verdicts = {name: r.determined for name, r in outlook.calibration.lidars.items()}
    for name, sigma in outlook.sigma_s2v.items():
        extrinsics.add_row(Text(name), *_sigma_cells(sigma, verdicts[name]))
    parts = titled(f"{word} 1 sigma of each mounting, vehicle axes", extrinsics)
    if outlook.sigma_s2s:
        pairs = new_table("from\nto", *axis_headings("mm", "mrad"))
        for (a, b), sigma in outlook.sigma_s2s.items():
            cells = _sigma_cells(sigma, outlook.determined_s2s[a, b])
            pairs.add_row(Text(f"{a}\n{b}"), *cells)
        parts += titled(f"{word} 1 sigma of one LiDAR against another, vehicle axes", pairs)
    held = any(not known for verdict in verdicts.values() for known in verdict.values())
    if held:
        note = "In brackets: the drive does not determine it; it will be the initial guess's."
        parts.append(Text(note, style="yellow"))
    offsets = [f"LiDAR '{n}': {1e3 * s:.2f} ms" for n, s in outlook.offsets_s.items()]
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
    """A number above zero to two or three digits, without an exponent."""
    decimals = min(max(1 - math.floor(math.log10(max(value, 1e-6))), 0), 3)
    return f"{value:.{decimals}f}"


def _direction_parts(outlook: PredictedCovariance) -> list[RenderableType]:
    lost: Sequence[str] = [
        *direction_texts(outlook.undetermined),
        *(
            f"LiDAR '{name}' never sees a target: nothing of it is told"
            for name in outlook.unseeing
        ),
    ]
    parts = sentences("What the drive cannot tell:", lost)
    parts += sentences("What it tells only weakly:", direction_texts(outlook.weak))
    if not lost:
        parts += ["", Text("It leaves nothing undetermined.", style="bold green")]
    scaled = ", ".join(_three_digits(s) if s < 1e4 else "none" for s in _finite(outlook))
    parts += ["", Text(f"Spectrum (1 sigma of the data, where 1 mrad counts as 10 mm): {scaled}")]
    return parts


def _finite(outlook: PredictedCovariance) -> Iterable[float]:
    return (float(s) for s in outlook.uncertainty.spectrum)


def _outlook_document(outlook: PredictedCovariance) -> dict[str, Any]:
    content = calibration_document(outlook.calibration)
    lidars = {
        name: {
            "sigma_vehicle_axes": _sigma_document(sigma),
            "determined": content["lidars"][name]["determined"],
            "sees_target": name not in outlook.unseeing,
            **(
                {"time_offset": {"sigma": outlook.offsets_s[name]}}
                if name in outlook.offsets_s
                else {}
            ),
        }
        for name, sigma in outlook.sigma_s2v.items()
    }
    pairs = [
        {
            "from": a,
            "to": b,
            "sigma_vehicle_axes": _sigma_document(sigma),
            "determined": dict(outlook.determined_s2s[a, b]),
        }
        for (a, b), sigma in outlook.sigma_s2s.items()
    ]
    document = {
        "status": content["status"],
        "reference": content["reference"],
        "lidars": lidars,
        "sensor_to_sensor": pairs,
        "observability": {
            **content["observability"],
            "spectrum": [float(f"{s:.6g}") for s in _finite(outlook)],
        },
    }
    plain: dict[str, Any] = without_infinities(document)
    return plain


def _sigma_document(sigma: Array) -> dict[str, list[float]]:
    return {
        "rpy_deg": [float(f"{v:.6g}") for v in np.degrees(sigma[:3])],
        "xyz": [float(f"{v:.6g}") for v in sigma[3:]],
    }
