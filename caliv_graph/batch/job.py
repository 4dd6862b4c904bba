"""The main job from files to files: what `calibrate` does once, and `batch` for every drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from caliv_graph.common.files import each_once
from caliv_graph.common.progress import SilentProgress, StageRecord
from caliv_graph.config.model import Config, PoseConfig
from caliv_graph.errors import ConfigError
from caliv_graph.products import Calibration, Recording
from caliv_graph.readers import open_recording
from caliv_graph.report.folder import write_result

if TYPE_CHECKING:
    from caliv_graph.results.run import CalibrationRun


@dataclass(frozen=True)
class FinishedJob:
    """A calibration that is ready to be written.

    Attributes:
        run: what the pipeline left.
        config: the effective one: with the (first) drive's path, whole, so that it can move.
        stages: what was done, and how long it took.
        warnings: what a person should know, a line each.
    """

    run: CalibrationRun
    config: Config
    stages: Sequence[StageRecord]
    warnings: tuple[str, ...]

    @property
    def calibration(self) -> Calibration:
        """The result."""
        return self.run.calibration

    def write(self, folder: Path) -> None:
        """Writes all files of the result into an empty folder.

        Raises:
            OSError: something cannot be written.
            OutputError: likewise.
        """
        write_result(
            folder,
            self.calibration,
            self.run.solution,
            self.config,
            self.stages,
            self.warnings,
            self.run.record,
        )


def open_recordings(config: Config, data: Sequence[Path]) -> list[Recording]:
    """Opens the drives of a job.

    Args:
        config: the configuration.
        data: drives instead of `data.path` of the config; empty: that one.

    Raises:
        ConfigError: a drive is given twice, or there is none.
        RecordingError: one is missing, incomplete or contradicts itself.
    """
    each_once(data, "--data ", "a drive")
    return [open_recording(config, path) for path in data or (None,)]


def check_guesses(config: Config, path: Path) -> None:
    """Refuses a config that `init` drafted and nobody filled in.

    Args:
        config: the configuration.
        path: its file.

    Raises:
        ConfigError: two LiDARs still have the zeros that `init` writes where it knows no better.
    """
    unknown = PoseConfig(xyz=(0.0, 0.0, 0.0))
    zeros = [name for name, lidar in config.lidars.items() if lidar.initial == unknown]
    if len(zeros) > 1:
        fields = " and ".join(f"lidars.{name}.initial" for name in zeros)
        raise ConfigError(
            f"{path}: {fields} are all zeros, but two LiDARs are not in one place. Measure where "
            "they are, or read it off a drawing"
        )


def run_job(
    recordings: Sequence[Recording],
    config: Config,
    progress: SilentProgress,
    prior: Calibration | None = None,
) -> FinishedJob:
    """Calibrates, and gathers what is to be written and said.

    Args:
        recordings: opened drives.
        config: the configuration.
        progress: reports every stage.
        prior: an earlier calibration of the vehicle.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    # Here, for whoever only looks at a job has no use for the estimator.
    from caliv_graph.pipeline import calibrate

    run = calibrate(recordings, config, progress, prior)
    calibration = run.calibration
    path = Path(recordings[0].name).resolve()
    return FinishedJob(
        run=run,
        config=config.model_copy(update={"data": config.data.model_copy(update={"path": path})}),
        stages=progress.stages,
        warnings=(
            *_unused_keys(config),
            *calibration.contradictions,
            *run.warnings,
            *calibration.unmet,
        ),
    )


def _unused_keys(config: Config) -> list[str]:
    """A line for each key that is set and has no effect."""
    if config.data.format == "rosbag":
        return []
    sections = {"topics": config.topics, "imu": config.imu, "gnss": config.gnss}
    return [
        f"{name}: has no effect on a CaLiV folder, which brings its poses"
        for name, section in sections.items()
        if section != type(section)()
    ]
