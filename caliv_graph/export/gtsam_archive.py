"""GTSAM: a joint prior on the extrinsics as an archive, and as a YAML that needs no version.

Three files (`fusion.archive`): the factors, their values beside them, and the YAML, which has the
comment: an archive has no place for one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.covariance import joint_covariance
from caliv_graph.export.request import DEFAULT_VEHICLE_FRAME, Export, Request, Transform
from caliv_graph.export.wording import notice, with_hash
from caliv_graph.fusion.archive import (
    archive_document,
    archive_paths,
    calibration_graph,
    serialise,
)
from caliv_graph.fusion.priors import lettered_keys


def export(request: Request) -> Export:
    """A graph of one factor over the extrinsics, and values, as GTSAM serialises them.

    Raises:
        ExportError: the letter is none, the covariance has no inverse, or the YAML would have the
            name of the archive.
    """
    factors, values_path, document_path = archive_paths(request.out)
    if document_path == factors:
        raise ExportError(
            f"{request.out}: is the name of the YAML that is written beside the archive. Give "
            f"--out {request.out.with_suffix('.gtsam')}"
        )
    calibration = replace(
        request.calibration,
        lidars={name: request.calibration.lidars[name] for name in request.lidars},
        cov_joint=joint_covariance(request),
    )
    graph, values = calibration_graph(calibration, request.letter)
    key = lettered_keys(calibration, request.letter)
    transforms = tuple(
        Transform(
            name,
            request.vehicle_frame or DEFAULT_VEHICLE_FRAME,
            name,
            request.T_vehicle_lidar(name),
            f"Variable {request.letter}{i}.",
        )
        for i, name in enumerate(request.lidars)
    )
    extra = [
        "Variables are Pose3 T_vehicle_lidar; tangent: rotation, translation; right: T Exp(d).",
        "information: joint, variables in their order; the error is d^T information d / 2.",
        f"{factors.name} and {values_path.name} hold the same for the GTSAM that wrote them: "
        "NonlinearFactorGraph and Values, deserialize().",
    ]
    document = archive_document(calibration, key, graph, values)
    text = with_hash(notice(request, transforms, extra)) + yaml.safe_dump(
        document, sort_keys=False, default_flow_style=None, width=math.inf
    )
    return Export(
        serialise(graph).encode(),
        transforms,
        beside={values_path: str(values.serialize()).encode(), document_path: text.encode()},
    )
