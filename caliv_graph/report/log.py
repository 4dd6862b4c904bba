"""log.jsonl: what a run did and found, a JSON object per line, for programs.

Every line has one key that says what it is about: `stage`, `recording`, `trajectory`, `ground`,
`clouds`, `registration`, `iteration`, `solution`, `residuals`, `down_weighted`, `result` or
`warning`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from caliv_graph.common.progress import StageRecord
from caliv_graph.config.model import RobustConfig
from caliv_graph.conventions import AXES
from caliv_graph.products import Calibration, Solution
from caliv_graph.report.residuals import (
    Residuals,
    all_residuals,
    down_weighted,
)
from caliv_graph.results.run import RunRecord
from caliv_graph.trajectory.smoothed import SmoothedTrajectory


def stage_documents(stages: Sequence[StageRecord]) -> list[dict[str, Any]]:
    """What was done and how long it took, plain values only."""
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
    evidence: RunRecord | None,
) -> Iterator[dict[str, Any]]:
    """The lines, plain values only. SI units; the names of the keys say which.

    Args:
        calibration: the result.
        solution: the solved graph.
        robust: the kernel, which tells why clouds were weighed down.
        stages: what was done.
        warnings: a line each.
        evidence: what it was made from; None: its lines are left out.
    """
    yield from stage_documents(stages)
    if evidence is not None:
        yield from _evidence(evidence)
    for registration, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
        clouds = registration.observation.clouds
        for name in dict.fromkeys(cloud.lidar for cloud in clouds):
            mine = np.array([cloud.lidar == name for cloud in clouds], dtype=bool)
            yield {
                "clouds": registration.observation.name,
                "lidar": name,
                "scans": int(mine.sum()),
                "points": sum(len(c.points_lidar) for c in clouds if c.lidar == name),
                "cut": sum(c.cut for c in clouds if c.lidar == name),
                "median_inlier_ratio": _short(np.median(registration.inlier_ratio[mine])),
                "weights": [_short(w) for w in weights[mine]],
                "stamps_ns": [c.stamp_ns for c in clouds if c.lidar == name],
            }
        turn, shift = registration.last_step
        yield {
            "registration": registration.observation.name,
            "clouds": len(registration.T_target_lidar),
            "components": len(registration.mixture.means_target),
            "iterations": registration.iterations,
            "converged": bool(registration.converged),
            "last_step_rad": _short(turn),
            "last_step_m": _short(shift),
        }
    for number, iteration in enumerate(solution.course, start=1):
        yield {
            "iteration": number,
            "step_rad": _short(iteration.turn_rad),
            "step_m": _short(iteration.shift_m),
            "step_sigmas": _short(iteration.sigmas),
            "weight_change": _short(iteration.weight_change),
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
    if evidence is not None:
        for residuals in all_residuals(solution, evidence):
            yield _residuals(residuals)
    for cloud in down_weighted(solution, robust):
        yield {
            "down_weighted": cloud.source,
            "lidar": cloud.lidar,
            "target": cloud.target,
            "drive": cloud.drive,
            "stamp_ns": cloud.stamp_ns,
            "weight": _short(cloud.weight),
            "residual_rad": _short(cloud.turn_rad),
            "residual_m": _short(cloud.shift_m),
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


def _evidence(evidence: RunRecord) -> Iterator[dict[str, Any]]:
    for drive, (name, trajectory) in enumerate(
        zip(evidence.drives, evidence.trajectories, strict=True)
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
                else [_short(v) for v in trajectory.yaw_bias],
            }
        else:
            line["poses"] = len(trajectory.trajectory.stamps_ns)
        yield line
        of_drive = [ground for ground in evidence.grounds if ground.drive == drive]
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
        "whitened_rms": _short(residuals.rms),
        "beyond_3_sigma": _short(residuals.beyond_three),
        "median_abs": {
            f"{quantity}_{unit.replace('/', '_')}": _short(np.median(np.abs(values)))
            for quantity, (unit, values) in residuals.physical.items()
        },
    }


def _short(value: Any) -> float:
    return float(f"{float(value):.6g}")
