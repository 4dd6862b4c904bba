"""How much better the smoothed trajectory is than a UKF on the same sensors, and how honest.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/benchmark_trajectory.py

Simulates IMU, GNSS, velocity and orientation of `paper_arc` and `figure_eight` with seeds 0 to 19
(`--seeds`), smooths and filters them with the true noise figures and the same prior on biases and
start, and compares both with the truth at the LiDAR's stamps, the first 2 s left out. RMSE are of
the length of the error vector. NEES is e^T C^-1 e of each pose with the covariance that the
smoother states, 6 if that is right; its interval is for as many independent poses as there are
seeds. Joint NEES is that of all poses of a drive together, per degree of freedom, 1 if right.

    .venv/bin/python scripts/benchmark_trajectory.py --solvers

compares this package's Levenberg-Marquardt loop with GTSAM's optimisers on the graph of the
`figure_eight` drive of seed 0 (60 s), from the same initial guess, and times the marginals. Each
line gives the fastest of three solves, its ratio to the package's own loop in the same run, and the
largest difference of a pose.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: the matrices are small
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # for the filter beside this script, run from anywhere

import gtsam
import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.conventions import key_imu
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation import simulate_drive
from caliv_graph.simulation.recording import SimulatedTruth
from caliv_graph.trajectory.build import build_graph, to_values
from caliv_graph.trajectory.chain import Chain
from caliv_graph.trajectory.initial import first_states
from caliv_graph.trajectory.inputs import check_input
from caliv_graph.trajectory.marginals import Marginals, node_ordering
from caliv_graph.trajectory.nodes import place_nodes
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import ERROR_TOLERANCE, MAX_STEPS, chain_of, optimise
from scripts._ukf import filter_trajectory

SCENARIOS = ("paper_arc", "figure_eight")
LEFT_OUT_S = 2.0
JOINT_STRIDE = 5
"""Every so many poses enter the joint NEES: that of all of a long drive takes seconds."""

T = TypeVar("T")

TARGET_POSITION, TARGET_ROTATION = 1.5, 1.3


@dataclass(frozen=True)
class Run:
    """Mean squares of one seed.

    Attributes:
        smoothed: of position error (m^2) and rotation error (rad^2) of the smoother.
        filtered: the same of the filter.
        nees: mean over the poses, of the smoother.
        nees_filtered: the same of the filter: it is no straw man if that is right as well.
        joint_nees: of all poses together.
        joint_dof: its degrees of freedom.
        seconds: that smoothing took.
    """

    smoothed: tuple[float, float]
    filtered: tuple[float, float]
    nees: float
    nees_filtered: float
    joint_nees: float
    joint_dof: int
    seconds: float


def config_of(scenario: Scenario) -> Config:
    """What a user would know: extrinsics; the noise is in the messages or the paper's."""
    imu = scenario.imu.mounting
    raw = {
        "lidars": {
            name: {"topic": f"/{name}", "initial": lidar.mounting.model_dump()}
            for name, lidar in scenario.lidars.items()
        },
        "imu": {"T_vehicle_imu": imu.model_dump()},
        "gnss": {"lever_arm": scenario.gnss.lever_arm},
    }
    return parse_config(raw, scenario.name, REPOSITORY)


def errors(
    truth: SimulatedTruth, motion: MotionData, stamps_ns: IntArray, R: Array, t: Array
) -> tuple[Array, Array]:
    """(n, 3) rotation errors (rad) and (n, 3) position errors (m), both in vehicle axes.

    The trajectory's map begins at the first fix, the truth's at the datum.
    """
    assert motion.gnss is not None
    gnss = motion.gnss
    first = pymap3d.geodetic2enu(
        gnss.latitude_deg[:1], gnss.longitude_deg[:1], gnss.altitude_m[:1], *truth.datum
    )
    R_true, t_true = stack(truth.T_map_vehicle(stamps_ns))
    difference = t + np.concatenate(first) - t_true
    turn = Rotation.from_matrix(np.swapaxes(R_true, 1, 2) @ R).as_rotvec()
    return np.asarray(turn), np.einsum("nji,nj->ni", R, difference)


def mean_squares(turn: Array, shift: Array) -> tuple[float, float]:
    """Of position and rotation."""
    return float((shift**2).sum(axis=1).mean()), float((turn**2).sum(axis=1).mean())


def mean_nees(turn: Array, shift: Array, cov: Array) -> float:
    """Mean over the poses of e^T C^-1 e."""
    e = np.hstack([turn, shift])
    return float(np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e).mean())


def joint_nees(
    smoothed: SmoothedTrajectory, stamps_ns: IntArray, turn: Array, shift: Array
) -> tuple[float, int]:
    """NEES of several poses together, and its degrees of freedom."""
    information, _ = smoothed.joint_information(stamps_ns)
    e = np.hstack([turn, shift]).ravel()
    return float(e @ information @ e), len(e)


def run(scenario: Scenario, seed: int) -> Run:
    """Both estimates of one simulated drive."""
    recording = simulate_drive(scenario, seed)
    motion, config = recording.motion(), config_of(scenario)
    stamps = np.unique(np.concatenate([recording.scan_stamps_ns(n) for n in recording.lidars]))
    begin = time.perf_counter()
    smoothed = smooth_trajectory(motion, config, stamps)
    seconds = time.perf_counter() - begin
    at = smoothed.trajectory.stamps_ns
    late = at > at[0] + int(1e9 * LEFT_OUT_S)
    cov = smoothed.trajectory.cov
    assert cov is not None
    R, t = stack(smoothed.trajectory.T_map_vehicle)
    turn, shift = errors(recording.truth, motion, at[late], R[late], t[late])
    some = slice(None, None, JOINT_STRIDE)
    joint, dof = joint_nees(smoothed, at[late][some], turn[some], shift[some])
    R_ukf, t_ukf, cov_ukf = filter_trajectory(motion, config, at)
    filtered = errors(recording.truth, motion, at[late], R_ukf[late], t_ukf[late])
    return Run(
        mean_squares(turn, shift),
        mean_squares(*filtered),
        mean_nees(turn, shift, cov[late]),
        mean_nees(*filtered, cov_ukf[late]),
        joint,
        dof,
        seconds,
    )


def interval(dof: int, divisor: int) -> tuple[float, float]:
    """95% interval of a chi-square of `dof` degrees of freedom over a divisor."""
    return float(chi2.ppf(0.025, dof)) / divisor, float(chi2.ppf(0.975, dof)) / divisor


def table(name: str, runs: list[Run]) -> str:
    """The lines of one scenario."""
    smoothed: Array = np.sqrt(np.array([r.smoothed for r in runs]).mean(axis=0))
    filtered: Array = np.sqrt(np.array([r.filtered for r in runs]).mean(axis=0))
    ratio = filtered / smoothed
    n = len(runs)
    nees = float(np.mean([r.nees for r in runs]))
    low, high = interval(6 * n, n)
    dof = sum(r.joint_dof for r in runs)
    joint = sum(r.joint_nees for r in runs) / dof
    joint_low, joint_high = interval(dof, dof)
    met = ratio[0] >= TARGET_POSITION and ratio[1] >= TARGET_ROTATION and low <= nees <= high
    return "\n".join(
        [
            f"{name}: {n} seeds, {np.median([r.seconds for r in runs]):.2f} s to smooth one",
            "              position (mm)   orientation (mrad)",
            f"  UKF         {1e3 * filtered[0]:13.2f} {1e3 * filtered[1]:20.3f}",
            f"  smoothed    {1e3 * smoothed[0]:13.2f} {1e3 * smoothed[1]:20.3f}",
            f"  ratio       {ratio[0]:13.2f} {ratio[1]:20.2f}"
            f"   (wanted: {TARGET_POSITION} and {TARGET_ROTATION})",
            f"  NEES        {nees:13.2f}   95% interval {low:.2f} to {high:.2f}"
            f" (UKF: {np.mean([r.nees_filtered for r in runs]):.2f})",
            f"  joint NEES  {joint:13.3f}   95% interval {joint_low:.3f} to {joint_high:.3f}, "
            f"{dof} degrees of freedom",
            f"  {'as wanted' if met else 'NOT as wanted'}",
        ]
    )


def fastest(call: Callable[[], T]) -> tuple[T, float]:
    """What a call returns, and the seconds of the fastest of three."""
    seconds = math.inf
    for _ in range(3):
        begin = time.perf_counter()
        out = call()
        seconds = min(seconds, time.perf_counter() - begin)
    return out, seconds


def pose_difference(a: gtsam.Values, b: gtsam.Values, n: int) -> tuple[float, float]:
    """Largest difference of the IMU's poses, radians and metres, per axis."""
    pairs = [(a.atPose3(key_imu(i)), b.atPose3(key_imu(i))) for i in range(n)]
    steps = np.abs(np.array([one.localCoordinates(other) for one, other in pairs]))
    return float(steps[:, :3].max()), float(steps[:, 3:].max())


def gtsam_optimisers(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values
) -> Iterator[tuple[str, Callable[[], gtsam.Values]]]:
    """Names and solves of GTSAM's optimizers, their tolerances set as close to ours as they go."""
    for solver in ("MULTIFRONTAL_CHOLESKY", "SEQUENTIAL_CHOLESKY"):
        for parameters in (gtsam.GaussNewtonParams(), gtsam.LevenbergMarquardtParams()):
            parameters.setRelativeErrorTol(ERROR_TOLERANCE)
            parameters.setAbsoluteErrorTol(ERROR_TOLERANCE)
            parameters.setMaxIterations(MAX_STEPS)
            parameters.setLinearSolverType(solver)
            name = type(parameters).__name__.removesuffix("Params")
            optimiser: Any = getattr(gtsam, f"{name}Optimizer")

            def solve(make: Any = optimiser, parameters: Any = parameters) -> gtsam.Values:
                found: gtsam.Values = make(graph, start, parameters).optimize()
                return found

            yield f"{name}Optimizer, {solver}", solve


def compare_joint(
    chain: Chain, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, some: IntArray
) -> None:
    """Prints the time and difference of the joint information of some poses."""
    keys, right = [key_imu(i) for i in some.tolist()], len(chain.corner) - 1
    ours, own_s = fastest(lambda: chain.pose_information(some, held=[right]))
    theirs, seconds = fastest(
        lambda: gtsam.Marginals(graph, values).jointMarginalInformation(keys).fullMatrix()
    )
    size = np.sqrt(np.outer(ours.diagonal(), ours.diagonal()))
    print(
        f"joint information of {len(some)} poses: trajectory.chain {own_s:.2f} s, gtsam.Marginals "
        f"{seconds:.2f} s, {seconds / own_s:.1f} times as long, relative difference "
        f"{np.abs((theirs - ours) / size).max():.1e}"
    )


def compare_solvers(seed: int = 0) -> None:
    """Prints times and differences on one drive of a minute."""
    scenario = load_scenario(REPOSITORY / "configs/scenarios/figure_eight.yaml")
    recording = simulate_drive(scenario, seed)
    data, _ = check_input(recording.motion(), config_of(scenario))
    stamps = np.unique(np.concatenate([recording.scan_stamps_ns(n) for n in recording.lidars]))
    inertial = data.inertial
    inside = (stamps >= inertial.begin_ns) & (stamps <= inertial.end_ns)
    nodes = place_nodes(inertial, stamps[inside])
    n = len(nodes)
    states = first_states(data, nodes)
    none, kernel = np.zeros(0, dtype=np.int64), data.config.robust.kernel
    graph, seconds = fastest(lambda: build_graph(data, nodes, states, none, kernel).factors)
    start = to_values(states, data)
    print(
        f"drive of {1e-9 * (nodes[-1] - nodes[0]):.0f} s: {n} nodes, {graph.size()} factors, "
        f"built in {seconds:.2f} s"
    )
    own, own_s = fastest(lambda: optimise(graph, start, n, ERROR_TOLERANCE))
    print(f"trajectory.solve.optimise: {own_s:.2f} s, error {graph.error(own):.6f}", flush=True)
    for name, solve in gtsam_optimisers(graph, start):
        found, seconds = fastest(solve)
        turn, shift = pose_difference(own, found, n)
        print(
            f"{name}: {seconds:.2f} s, {seconds / own_s:.1f} times as long, error "
            f"{graph.error(found):.6f}, poses differ by up to {turn:.1e} rad, {shift:.1e} m",
            flush=True,
        )
    linear = graph.linearize(own)
    ordering = node_ordering(n, data.yaw_bias)
    poses = [key_imu(i) for i in range(n)]
    _, seconds = fastest(lambda: Marginals(linear, ordering).covariances(poses))
    print(f"marginal covariances of {n} poses, GTSAM's Bayes tree by QR: {seconds:.2f} s")
    chain = chain_of(linear, n, data.yaw_bias)
    for stride in (4, 2):
        compare_joint(chain, graph, own, np.arange(0, n, stride))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="number of seeds, from 0")
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), help="by name")
    parser.add_argument("--solvers", action="store_true", help="compare optimizers instead")
    arguments = parser.parse_args()
    if arguments.solvers:
        compare_solvers()
        return 0
    for name in arguments.scenarios:
        scenario = load_scenario(REPOSITORY / f"configs/scenarios/{name}.yaml")
        print(table(name, [run(scenario, seed) for seed in range(arguments.seeds)]), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
