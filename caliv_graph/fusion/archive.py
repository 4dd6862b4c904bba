"""A calibration as a GTSAM archive for localisers, and as YAML independent of GTSAM's version.

There are three files. NAME.gtsam is a serialised `NonlinearFactorGraph` (boost text archive).
NAME.values.gtsam holds its `Values`. NAME.yaml has the same numbers. A program with the same GTSAM
version reads the first two with `gtsam::deserializeFromFile`, or in Python with
`graph.deserialize(text)`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml

from caliv_graph.common.files import atomic_write, check_output_file
from caliv_graph.errors import ExportError
from caliv_graph.fusion.priors import (
    DEFAULT_LETTER,
    ExtrinsicKey,
    extrinsic_values,
    lettered_keys,
    prior_factors,
)
from caliv_graph.geometry.se3 import quaternion_xyzw
from caliv_graph.products import Calibration

SCHEMA = "caliv-graph/gtsam/1"

_HEADER = """\
# Priors on the extrinsics of LiDARs, written by caliv-graph for GTSAM. Metres, radians.
# T_vehicle_lidar maps points of the LiDAR into the vehicle: p_vehicle = T_vehicle_lidar p_lidar.
# Variables are Pose3, tangent order rotation (3) then translation (3), right perturbation T Exp(d).
# information is joint over the variables in their order: the error is d^T information d / 2.
"""


def archive_paths(path: Path) -> tuple[Path, Path, Path]:
    """The files of an archive: factors, values, YAML.

    Args:
        path: file of the factors, such as graph.gtsam.
    """
    return path, path.with_suffix(f".values{path.suffix}"), path.with_suffix(".yaml")


def serialise(graph: gtsam.NonlinearFactorGraph) -> str:
    """A graph as GTSAM's archive.

    Raises:
        ExportError: it holds a factor that GTSAM cannot serialise; `factors.serialisable` helps.
    """
    custom = [i for i in range(graph.size()) if isinstance(graph.at(i), gtsam.CustomFactor)]
    if custom:
        raise ExportError(
            f"graph: factor {custom[0]} is a CustomFactor, which GTSAM cannot serialise. Pass the "
            "graph to fusion.factors.serialisable first, which linearises it"
        )
    return str(graph.serialize())


def write_archive(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    path: Path,
    force: bool = False,
) -> tuple[Path, ...]:
    """Writes any graph of native factors, and its values.

    Args:
        graph: a graph without custom factors.
        values: values of its variables.
        path: file of the factors; the values are written beside it (`archive_paths`).
        force: replace older files.

    Returns:
        The files written.

    Raises:
        ExportError: GTSAM cannot serialise the graph.
        OutputError: a file exists and `force` is not set, or cannot be written.
    """
    text = serialise(graph)
    paths = archive_paths(path)[:2]
    for file in paths:
        check_output_file(file, force)
    # The file of the factors is last: if it exists, the values exist.
    atomic_write(paths[1], str(values.serialize()), force)
    atomic_write(paths[0], text, force)
    return paths


def calibration_graph(
    calibration: Calibration, letter: str = DEFAULT_LETTER, joint: bool = True
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The solution over the extrinsics, linearised: the content of `graph.gtsam`.

    Args:
        calibration: the result.
        letter: letter of the keys, numbered in the order of the calibration's LiDARs.
        joint: see `prior_factors`.

    Raises:
        ExportError: see `prior_factors`.
    """
    key = lettered_keys(calibration, letter)
    return prior_factors(calibration, key, joint), extrinsic_values(calibration, key)


def write_calibration_archive(
    calibration: Calibration,
    path: Path,
    letter: str = DEFAULT_LETTER,
    joint: bool = True,
    force: bool = False,
) -> tuple[Path, ...]:
    """Writes the priors of a calibration as an archive with its YAML.

    Args:
        calibration: the result.
        path: file of the factors; values and YAML are written beside it (`archive_paths`).
        letter: letter of the keys.
        joint: see `prior_factors`.
        force: replace older files.

    Returns:
        The files written.

    Raises:
        ExportError: see `prior_factors`.
        OutputError: a file exists and `force` is not set, or cannot be written.
    """
    graph, values = calibration_graph(calibration, letter, joint)
    document = archive_document(calibration, lettered_keys(calibration, letter), graph, values)
    for file in archive_paths(path):
        check_output_file(file, force)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=math.inf)
    atomic_write(archive_paths(path)[2], _HEADER + text, force)
    write_archive(graph, values, path, force)
    return archive_paths(path)


def archive_document(
    calibration: Calibration,
    key: ExtrinsicKey,
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
) -> dict[str, Any]:
    """The content of the YAML file, plain values only.

    Args:
        calibration: the result.
        key: key of each LiDAR.
        graph: its priors.
        values: their linearisation point.
    """
    ordering = gtsam.Ordering()
    variables = []
    for name, lidar in calibration.lidars.items():
        ordering.push_back(key(name))
        T = lidar.T_vehicle_lidar
        symbol = gtsam.Symbol(key(name))
        variables.append(
            {
                "lidar": name,
                "letter": chr(symbol.chr()),
                "index": int(symbol.index()),
                "key": int(key(name)),
                "T_vehicle_lidar": {
                    "translation": [float(v) for v in T.translation()],
                    "quaternion_xyzw": [float(v) for v in quaternion_xyzw(T.rotation())],
                },
                "determined": {axis: bool(yes) for axis, yes in lidar.determined.items()},
            }
        )
    information = np.asarray(graph.linearize(values).hessian(ordering)[0], dtype=np.float64)
    return {
        "schema": SCHEMA,
        "status": calibration.status,
        "variables": variables,
        "information": (0.5 * (information + information.T)).tolist(),
    }
