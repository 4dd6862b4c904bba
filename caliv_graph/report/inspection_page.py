"""The page of `inspect --html`: clouds under mountings that sliders move, the drive, the timeline.

The page loads nothing. It draws with its own script on plain canvases, without plotly.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

import caliv_graph
from caliv_graph.products import Array
from caliv_graph.report.bag_inspection import BagInspection
from caliv_graph.report.inspection import Inspection
from caliv_graph.report.inspection_table import TableText, content, title_of
from caliv_graph.report.page import environment, escaped
from caliv_graph.report.timeline import timeline
from caliv_graph.workflows.draft_text import scalar
from caliv_graph.workflows.scene import RANGE_M, Piece, Scene, SceneLidar

QUANTUM_M = 0.002
"""Of a coordinate: below the noise of any LiDAR, and `RANGE_M` still fits into 16 bits."""

assert QUANTUM_M * np.iinfo(np.int16).max > RANGE_M


def render_inspection(
    inspection: Inspection | BagInspection, scene: Scene, warnings: Sequence[str]
) -> str:
    """The page, an HTML document of at most 10 MB.

    `warnings` are those of the terminal; the findings of the inspection are among them.
    """
    return (
        environment()
        .get_template("inspection.html.j2")
        .render(
            title=title_of(inspection),
            scene=scene,
            has_map=bool(len(scene.path_map) or len(scene.fixes_map)),
            has_along=any(lidar.along for lidar in scene.lidars),
            timeline=timeline(inspection),
            content=[(isinstance(part, TableText), part) for part in content(inspection)],
            warnings=list(dict.fromkeys([*scene.problems, *warnings])),
            data=escaped(
                json.dumps(_scene_document(scene), separators=(",", ":"), allow_nan=False)
            ),
            version=caliv_graph.__version__,
        )
    )


def _scene_document(scene: Scene) -> dict[str, Any]:
    """The scene as the script takes it."""
    return {
        "quantum_m": QUANTUM_M,
        "lidars": [_lidar_document(lidar) for lidar in scene.lidars],
        "T_map_view": _rows(scene.T_map_view),
        "T_map_start": _rows(scene.T_map_start),
        "path": _rounded(scene.path_map, 3),
        "fixes": _rounded(scene.fixes_map, 3),
        "boxes": [
            {
                "name": box.name,
                "min": list(box.region.min),
                "max": list(box.region.max),
                "frame": box.region.frame,
                "found": box.found,
            }
            for box in scene.boxes
        ],
    }


def _lidar_document(lidar: SceneLidar) -> dict[str, Any]:
    initial = lidar.initial
    return {
        "name": lidar.name,
        "key": scalar(lidar.name),
        "topic": lidar.topic,
        "origin": lidar.origin,
        "known": initial is not None and initial.xyz != (0.0, 0.0, 0.0),
        "xyz": _rounded([0.0] * 3 if initial is None else initial.xyz, 6),
        "rpy_deg": _rounded([0.0] * 3 if initial is None else initial.rpy_deg, 6),
        "once": _pieces(lidar.once),
        "along": _pieces(lidar.along),
    }


def _pieces(pieces: Sequence[Piece]) -> dict[str, Any]:
    """Points as 16-bit integers in base64; per piece the number of points and the pose."""
    points = np.concatenate([np.zeros((0, 3)), *(piece.points_lidar for piece in pieces)])
    raw = np.round(points / QUANTUM_M).astype("<i2").tobytes()
    return {
        "points": base64.b64encode(raw).decode("ascii"),
        "pieces": [[len(p.points_lidar), _rows(p.T_view_vehicle)] for p in pieces],
    }


def _rows(T: gtsam.Pose3 | None) -> list[float] | None:
    """The first three rows of a pose's matrix."""
    return None if T is None else _rounded(T.matrix()[:3].ravel(), 7)


def _rounded(values: Array | Sequence[float], digits: int) -> Any:
    # The zero, so that no minus sign stands before zeros.
    return (np.round(np.asarray(values, dtype=np.float64), digits) + 0.0).tolist()
