"""The walls that LiDARs see on a planned or a recorded drive: tables and plain values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import RenderableType
from rich.text import Text

from caliv_graph.report.layout import new_table, sentences, titled
from caliv_graph.wording.structure import shared_walls_sentence

if TYPE_CHECKING:
    from caliv_graph.planning.predict import Prediction
    from caliv_graph.workflows.survey import Survey

SHARED = "Walls that two LiDARs see:"


def wall_parts(prediction: Prediction) -> list[RenderableType]:
    """Scans per wall and LiDAR, and what the LiDARs share; nothing if there are no walls."""
    several = len(prediction.names) > 1
    lidars = tuple(prediction.covariance.calibration.lidars)
    table = new_table(*(("drive",) if several else ()), "wall", *lidars)
    lines = []
    for drive, seen in zip(prediction.names, prediction.walls, strict=True):
        if seen is None:
            continue
        for wall in dict.fromkeys(wall for wall, _ in seen.scans):
            cells = [str(seen.scans.get((wall, name), "never")) for name in lidars]
            table.add_row(*([Text(drive)] if several else []), Text(wall), *cells)
        for (a, b), strips in seen.strips.items():
            sentence = shared_walls_sentence(a, b, strips, seen.shared[a, b])
            lines.append(f"{drive}: {sentence}" if several else sentence)
    if not table.rows:
        return []
    return [
        *titled("Scans in which each LiDAR sees a wall", table),
        *sentences(SHARED, lines),
    ]


def wall_document(prediction: Prediction) -> dict[str, Any]:
    """The same as plain values; no keys if there are no walls."""
    if not any(prediction.walls):
        return {}
    seen = [
        (drive, walls)
        for drive, walls in zip(prediction.names, prediction.walls, strict=True)
        if walls is not None
    ]
    return {
        "walls": [
            {"drive": drive, "wall": wall, "lidar": lidar, "scans": scans}
            for drive, walls in seen
            for (wall, lidar), scans in walls.scans.items()
        ],
        "shared_walls": [
            {"drive": drive, "lidars": [a, b], "strips": strips, "walls": list(walls.shared[a, b])}
            for drive, walls in seen
            for (a, b), strips in walls.strips.items()
        ],
    }


def surveyed_wall_parts(survey: Survey) -> list[RenderableType]:
    """Sightings of walls per LiDAR, and what LiDARs share; nothing without structure."""
    if not survey.wall_sightings:
        return []
    table = new_table("LiDAR", "pieces of wall x scans")
    for name, count in survey.wall_sightings.items():
        table.add_row(Text(name), str(count))
    lines = [shared_walls_sentence(a, b, n) for (a, b), n in survey.shared_walls.items()]
    return [*titled("Walls that each LiDAR sees", table), *sentences(SHARED, lines)]


def surveyed_wall_document(survey: Survey) -> dict[str, Any]:
    """The same as plain values; no keys without structure."""
    if not survey.wall_sightings:
        return {}
    return {
        "wall_sightings": dict(survey.wall_sightings),
        "shared_walls": [
            {"lidars": list(pair), "strips": strips} for pair, strips in survey.shared_walls.items()
        ],
    }
