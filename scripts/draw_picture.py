"""Draws the README's picture: the demo's drive in the map, before and after the calibration.

Needs the environment and the drive that scripts/demo makes:

    scripts/demo
    .venv/bin/python scripts/draw_picture.py

Both panels of a row show the same points of the same scans at the same scale. Only the extrinsics
differ: the initial guesses of the config on the left, the calibration on the right. The vehicle's
poses are those of the smoothed trajectory. The errors in the titles are against the true extrinsics
of the simulation: the lengths of the translation and of the rotation vector.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: the matrices are small
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))

import gtsam
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError
from caliv_graph.products import Array, IntArray
from caliv_graph.readers import open_recording
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories

PICTURE = REPOSITORY / ".github/picture.png"

LARGEST_BYTES = 300_000
"""What a page that is opened often should load for a picture."""

PALETTE = 48
"""Colours in the file: two, the ink, and their mixtures."""

SCANS = 8
"""Scans of each LiDAR in the picture. More of them would hide each other."""

NEAR_M = 13.0
"""Scans from farther away have few points on the target."""

SEES_POINTS = 100
"""Points above the ground that make a scan one of the target."""

ABOVE_GROUND_M = 0.05
"""Lower points are ground: the view from above leaves them out."""

GROUND_STRIDE = 3
"""The view from the front shows every third point of the ground, which has most of the points."""

HALF_WIDTH_M = 0.95
"""Of a panel. The guesses displace the points by up to 0.6 m."""

ABOVE_M = (-0.98, 0.55)
"""Of the view from above, from the chair's middle towards its back."""

HEIGHT_M = (-0.45, 1.8)
"""Of the view from the front, above the ground."""

COLOURS = ("#0969da", "#e8590c")
"""Blue and orange, which colour-blind people tell apart."""

INK = "#1f2328"

Poses = Mapping[str, gtsam.Pose3]
StringArray = npt.NDArray[np.str_]


@dataclass(frozen=True)
class Points:
    """Points of the target and of the ground around it, by two sets of extrinsics.

    Attributes:
        lidar: (N,) index of the LiDAR that measured each point.
        before: (N, 3) metres, map, by the initial guesses.
        after: (N, 3) metres, map, by the calibration.
    """

    lidar: IntArray
    before: Array
    after: Array


def main() -> int:
    arguments = _parse_arguments()
    demo, out = arguments.demo.resolve(), arguments.out.resolve()
    try:
        config = load_config(demo / "drive/config.yaml")
        calibration = read_calibration(demo / "result/calibration.yaml")
        truth = read_truth(demo / "drive/truth.yaml")
        after = {name: lidar.T_vehicle_lidar for name, lidar in calibration.lidars.items()}
        before = {name: lidar.guess() for name, lidar in config.lidars.items()}
        points = points_in_the_map(config, before, after)
    except (CalivError, OSError) as e:
        print(f"error: {e}. Run scripts/demo first", file=sys.stderr)
        return 2
    titles = (
        f"BEFORE: initial guesses\n{errors_in_words(before, truth)}",
        f"AFTER: calibration\n{errors_in_words(after, truth)}",
    )
    content = as_png(draw(points, tuple(config.lidars), titles), arguments.dpi)
    if len(content) > LARGEST_BYTES:
        print(f"error: {len(content)} bytes, over {LARGEST_BYTES}. Lower --dpi", file=sys.stderr)
        return 1
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(content)
    print(f"{out}: {len(content) / 1000:.0f} kB")
    return 0


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Draws the README's picture from the drive and the result of scripts/demo."
    )
    parser.add_argument(
        "--demo",
        metavar="DIR",
        type=Path,
        default=REPOSITORY / "out/demo",
        help="folder that scripts/demo has written (default: out/demo)",
    )
    parser.add_argument(
        "--out",
        metavar="PNG",
        type=Path,
        default=PICTURE,
        help="where to write it (default: .github/picture.png)",
    )
    parser.add_argument("--dpi", type=int, default=140, help="dots per inch (default: 140)")
    return parser.parse_args()


def points_in_the_map(config: Config, before: Poses, after: Poses) -> Points:
    """The points of the target's region in some scans, by two sets of extrinsics.

    Args:
        config: of the drive; it names the target's region in the map.
        before: T_vehicle_lidar per LiDAR.
        after: T_vehicle_lidar per LiDAR; these decide which points are in the region.

    Raises:
        CalivError: the recording cannot be read, or the config names no region.
    """
    if not config.target:
        raise CalivError("config.yaml: names no target region")
    low, high = np.array(config.target[0].min), np.array(config.target[0].max)
    recording = open_recording(config)
    motion = {0: recording.motion()}
    (rough,) = smooth_trajectories([recording], config, [[]], motion)
    chosen = {
        name: _stamps_near(recording.scan_stamps_ns(name), rough, 0.5 * (low + high))
        for name in config.lidars
    }
    stamps = np.unique(np.concatenate(list(chosen.values())))
    (trajectory,) = smooth_trajectories([recording], config, [stamps], motion)
    lidar, by_guess, by_result = [], [], []
    for index, name in enumerate(config.lidars):
        seen = []
        for scan in recording.scans(name, set(chosen[name].tolist())):
            R, t = trajectory.poses_at([scan.stamp_ns])
            T_map_vehicle = gtsam.Pose3(gtsam.Rot3(R[0]), t[0])
            placed = [
                T_map_vehicle.compose(poses[name]).transformFrom(scan.points_lidar.T).T
                for poses in (before, after)
            ]
            inside = ((placed[1] >= low) & (placed[1] <= high)).all(axis=1)
            if (placed[1][inside, 2] > ABOVE_GROUND_M).sum() > SEES_POINTS:
                seen.append([points[inside] for points in placed])
        for i in np.unique(np.linspace(0, len(seen) - 1, SCANS).astype(int)) if seen else ():
            guessed, found = seen[i]
            lidar.append(np.full(len(found), index))
            by_guess.append(guessed)
            by_result.append(found)
    return Points(np.concatenate(lidar), np.concatenate(by_guess), np.concatenate(by_result))


def _stamps_near(
    stamps_ns: Sequence[int], trajectory: VehicleTrajectory, place_map: Array
) -> IntArray:
    """Stamps at which the vehicle is within `NEAR_M` of a place."""
    begin, end = trajectory.span_ns
    stamps = np.array([t for t in stamps_ns if begin <= t <= end], dtype=np.int64)
    _, t = trajectory.poses_at(stamps)
    return np.asarray(stamps[np.linalg.norm((t - place_map)[:, :2], axis=1) < NEAR_M])


def errors_in_words(found: Poses, truth: Poses) -> str:
    """Errors of the first pair of LiDARs and of the worst LiDAR, in a title's two lines."""
    source, to = list(found)[:2]
    pair = _error(found[to].between(found[source]), truth[to].between(truth[source]))
    alone = np.max([_error(found[name], truth[name]) for name in found], axis=0)
    return (
        f"{source} to {to}: {_in_units(pair)} off\nLiDAR to vehicle: {_in_units(alone)} off at most"
    )


def _error(T: gtsam.Pose3, T_true: gtsam.Pose3) -> Array:
    """Lengths of the translation error (mm) and of the rotation error (mrad)."""
    turn = gtsam.Rot3.Logmap(T_true.rotation().between(T.rotation()))
    return 1e3 * np.array(
        [np.linalg.norm(T.translation() - T_true.translation()), np.linalg.norm(turn)]
    )


def _in_units(error: Array) -> str:
    mm, mrad = (f"{value:.0f}" if value >= 20.0 else f"{value:.2g}" for value in error)
    return f"{mm} mm, {mrad} mrad"


def draw(points: Points, lidars: Sequence[str], titles: tuple[str, str]) -> Figure:
    """Two columns, before and after; two rows, from above and from the front."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(points.lidar))  # neither LiDAR lies on top of the other
    colours = np.array(COLOURS)[points.lidar[order]]
    target = points.after[order, 2] > ABOVE_GROUND_M
    visible = target | (np.arange(len(order)) % GROUND_STRIDE == 0)
    centre = np.median(points.after[order][target], axis=0)
    figure = Figure(figsize=(8.4, 8.6), facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2, height_ratios=[high - low for low, high in (ABOVE_M, HEIGHT_M)])
    for column, (cloud, title) in enumerate(
        zip((points.before, points.after), titles, strict=True)
    ):
        x, y, z = (cloud[order] - [centre[0], centre[1], 0.0]).T
        above, front = panels[0, column], panels[1, column]
        _panel(above, -y[target], x[target], colours[target], ABOVE_M)
        _panel(front, -y[visible], z[visible], colours[visible], HEIGHT_M)
        above.set_title(title, fontsize=11, color=INK, linespacing=1.4)
    panels[0, 0].set_ylabel("seen from above", fontsize=11, color=INK)
    panels[1, 0].set_ylabel("seen from the front", fontsize=11, color=INK)
    _scale_bar(panels[0, 0])
    marks = [
        Line2D([], [], marker="o", linestyle="", color=colour, label=f"LiDAR '{name}'")
        for name, colour in zip(lidars, COLOURS, strict=False)
    ]
    figure.legend(handles=marks, loc="lower center", ncols=2, frameon=False, fontsize=11)
    figure.tight_layout(rect=(0.0, 0.03, 1.0, 1.0))
    return figure


def _panel(
    panel: Axes, x: Array, y: Array, colours: StringArray, span: tuple[float, float]
) -> None:
    panel.scatter(x, y, s=1.6, c=colours.tolist(), linewidths=0)
    panel.set_xlim(-HALF_WIDTH_M, HALF_WIDTH_M)
    panel.set_ylim(*span)
    panel.set_aspect("equal")
    panel.set_xticks([])
    panel.set_yticks([])
    for spine in panel.spines.values():
        spine.set_color("#8c959f")


def _scale_bar(panel: Axes) -> None:
    left, bottom = -HALF_WIDTH_M + 0.1, ABOVE_M[1] - 0.16
    panel.plot([left, left + 0.5], [bottom, bottom], color=INK, linewidth=2.5)
    panel.text(left + 0.25, bottom + 0.03, "0.5 m", ha="center", fontsize=10, color=INK)


def as_png(figure: Figure, dpi: int) -> bytes:
    """A figure as a PNG of few colours, a third of the size of one with all."""
    full, small = io.BytesIO(), io.BytesIO()
    figure.savefig(full, dpi=dpi, format="png")
    image = Image.open(full).convert("RGB").quantize(PALETTE, dither=Image.Dither.NONE)
    image.save(small, format="png", optimize=True)
    return small.getvalue()


if __name__ == "__main__":
    sys.exit(main())
