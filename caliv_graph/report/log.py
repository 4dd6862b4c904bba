"""log.jsonl: the course and the results of a run, one JSON object per line, for programs.

The first key of a line names its subject: `stage`, `recording`, `trajectory`, `ground`,
`structure`, `clouds`, `registration`, `iteration`, `solution`, `noise`, `residuals`,
`down_weighted`, `result` or `warning`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from caliv_graph.common.progress import StageRecord
from caliv_graph.config.model import RobustConfig
from caliv_graph.conventions import AXES
from caliv_graph.products import Calibration, Solution
from caliv_graph.report.numbers import rounded
from caliv_graph.report.residuals import Residuals, all_residuals, down_weighted
from caliv_graph.results.run import RunRecord
from caliv_graph.trajectory.smoothed import SmoothedTrajectory


def stage_documents(stages: Sequence[StageRecord]) -> list[dict[str, Any]]:
    """Stages with their durations, as plain values."""
    return [
        {
            "stage": stage.name,
            "depth": stage.depth,
            "seconds": None if stage.seconds is None else round(stage.seconds, 4),
            "cpu_seconds": None if stage.cpu_seconds is None else round(stage.cpu_seconds, 4),
            "done": stage.done,
            "total": stage.total,
            "note": stage.note,
        }
        for stage in stages
    ]


def log_documents(
    calibration: Calibration,
    solution: Solution,
    robust: RobustConfig,
    stages: Sequence[StageRecord],
    warnings: Sequence[str],
    record: RunRecord | None,
) -> Iterator[dict[str, Any]]:
    """The lines as plain values. SI units, named in the keys.

    `robust` is for the reasons of down-weighted clouds. Without a record, the lines of drives,
    trajectories and ground are left out.
    """
    yield from stage_documents(stages)
    if record is not None:
        yield from _trajectories(record)
    for term in solution.structure:
        used = [strip for strip in term.strips if strip.weight > 0.0]
        yield {
            "structure": term.drive,
            "lidars": list(term.T_vehicle_lidar),
            "poses": len(term.stamps_ns),
            "strips": len(term.strips),
            "dropped": sum(strip.weight == 0.0 for strip in term.strips),
            "surfaces": len({strip.surface for strip in term.strips}),
            "offset_m": rounded(term.offset_m),
            "scatter_m": _median([s.scatter_m for s in used]),
            "before_m": _median([s.before_m for s in used]),
        }
    for registration, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
        clouds = registration.observation.clouds
        for name in dict.fromkeys(cloud.lidar for cloud in clouds):
            mine = np.array([cloud.lidar == name for cloud in clouds], dtype=bool)
            yield {
                "clouds": registration.observation.name,
                "lidar": name,
                "scans": int(mine.sum()),
                "points": sum(len(c.points_lidar) for c in clouds if c.lidar == name),
                "cut": sum(bool(c.cut) for c in clouds if c.lidar == name),
                "median_inlier_ratio": rounded(np.median(registration.inlier_ratio[mine])),
                "weights": [rounded(w) for w in weights[mine]],
                "stamps_ns": [c.stamp_ns for c in clouds if c.lidar == name],
            }
        rotation, position = registration.last_step
        yield {
            "registration": registration.observation.name,
            "clouds": len(registration.T_target_lidar),
            "components": len(registration.mixture.means_target),
            "iterations": registration.iterations,
            "converged": bool(registration.converged),
            "last_step_rad": rounded(rotation),
            "last_step_m": rounded(position),
        }
    for number, iteration in enumerate(solution.course, start=1):
        yield {
            "iteration": number,
            "step_rad": rounded(iteration.turn_rad),
            "step_m": rounded(iteration.shift_m),
            "step_sigmas": rounded(iteration.sigmas),
            "weight_change": rounded(iteration.weight_change),
            "undetermined": iteration.undetermined,
        }
    yield {
        "solution": solution.mode,
        "iterations": solution.iterations,
        "converged": bool(solution.converged),
        "registration_scale": float(solution.registration_scale),
        "pose_noise": None if solution.pose_noise is None else asdict(solution.pose_noise),
        "held": list(solution.held),
        "seconds": {name: round(s, 4) for name, s in solution.stage_times_s.items()},
    }
    for level in solution.sensor_noise:
        yield {"noise": level.name, "sigma": rounded(level.sigma)} | {
            "unit": level.unit,
            "time_s": None if level.time_s is None else rounded(level.time_s),
            "from": level.source,
        }
    if record is not None:
        for residuals in all_residuals(solution, record):
            yield _residuals(residuals)
    for cloud in down_weighted(solution, robust):
        yield {
            "down_weighted": cloud.source,
            "lidar": cloud.lidar,
            "target": cloud.target,
            "drive": cloud.drive,
            "stamp_ns": cloud.stamp_ns,
            "weight": rounded(cloud.weight),
            "residual_rad": rounded(cloud.rotation_rad),
            "residual_m": rounded(cloud.position_m),
            "reason": cloud.reason,
        }
    yield {
        "result": calibration.status,
        "not_determined": {
            name: [axis for axis in AXES if not lidar.determined[axis]]
            for name, lidar in calibration.lidars.items()
        },
        "undetermined": [direction.text for direction in calibration.undetermined],
        "weak": [direction.text for direction in calibration.weak],
        "unmet": list(calibration.unmet),
        "contradictions": list(calibration.contradictions),
    }
    for warning in warnings:
        yield {"warning": warning}


def _median(values: Sequence[float]) -> float | None:
    """The median of those that are known; JSON has no NaN."""
    known = [value for value in values if math.isfinite(value)]
    return rounded(np.median(known)) if known else None


def _trajectories(record: RunRecord) -> Iterator[dict[str, Any]]:
    for drive, (name, trajectory) in enumerate(
        zip(record.drives, record.trajectories, strict=True)
    ):
        begin, end = trajectory.span_ns
        line: dict[str, Any] = {
            "trajectory": name,
            "drive": drive,
            "kind": "given",
            "begin_ns": begin,
            "end_ns": end,
            "scans_outside": len(trajectory.lost_ns),
        }
        if isinstance(trajectory, SmoothedTrajectory):
            kinds = trajectory.factor_kinds
            line |= {
                "kind": "smoothed",
                "nodes": len(trajectory.nodes_ns),
                "noise_from": dict(trajectory.noise_sources),
                "factors": {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)},
                "gnss_dropped": len(trajectory.gnss_rejected),
                "yaw_bias_rad": None
                if trajectory.yaw_bias is None
                else [rounded(v) for v in trajectory.yaw_bias],
            }
        else:
            line["poses"] = len(trajectory.trajectory.stamps_ns)
        yield line
        of_drive = [ground for ground in record.grounds if ground.drive == drive]
        for lidar in dict.fromkeys(ground.lidar for ground in of_drive):
            mine = [ground for ground in of_drive if ground.lidar == lidar]
            yield {
                "ground": name,
                "drive": drive,
                "lidar": lidar,
                "scans": len(mine),
                "points": sum(ground.points for ground in mine),
            }


def _residuals(residuals: Residuals) -> dict[str, Any]:
    return {
        "residuals": residuals.kind,
        "count": len(residuals.whitened),
        "whitened_rms": rounded(residuals.rms),
        "beyond_3_sigma": rounded(residuals.beyond_three),
        "median_abs": {
            f"{quantity}_{unit.replace('/', '_')}": rounded(np.median(np.abs(values)))
            for quantity, (unit, values) in residuals.physical.items()
        },
    }
