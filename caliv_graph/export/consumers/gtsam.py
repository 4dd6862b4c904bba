"""GTSAM: a joint prior on the extrinsics as an archive, and as a YAML for any version of GTSAM.

Three files (`fusion.archive`): the factors, their values, and the YAML, which has the comment,
since an archive cannot have one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.covariance import joint_covariance
from caliv_graph.export.request import Consumer, Export, Request, Transform
from caliv_graph.export.text import notice, with_hash
from caliv_graph.fusion.archive import (
    archive_document,
    archive_paths,
    calibration_graph,
    serialise,
)
from caliv_graph.fusion.priors import lettered_keys


def export(request: Request) -> Export:
    """A graph of one factor over the extrinsics and its values, serialised by GTSAM.

    Raises:
        ExportError: the letter is invalid, the covariance is singular, or archive and YAML would
            have the same name.
    """
    factors, values_path, document_path = archive_paths(request.out)
    if document_path == factors:
        raise ExportError(
            f"{request.out}: would be the name of the archive and of its YAML. Give "
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
            request.parent,
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


CONSUMER = Consumer(export, frozenset(("--letter",)))
