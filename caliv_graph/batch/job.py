"""One calibration from files to files: `calibrate` runs one, `batch` one per job."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from caliv_graph.common.files import each_once
from caliv_graph.common.progress import SilentProgress, StageRecord
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError, RecordingError
from caliv_graph.products import Calibration, Recording
from caliv_graph.readers import open_recording
from caliv_graph.report.folder import write_result

if TYPE_CHECKING:
    from caliv_graph.results.run import CalibrationRun


@dataclass(frozen=True)
class FinishedJob:
    """A calibration with all that its result folder contains.

    Attributes:
        run: the result of the pipeline.
        config: the effective config, with the absolute path of the (first) drive, so that it is
            valid in any folder.
        stages: of the run, with their durations.
        warnings: one line each.
    """

    run: CalibrationRun
    config: Config
    stages: Sequence[StageRecord]
    warnings: tuple[str, ...]

    @property
    def calibration(self) -> Calibration:
        """The result."""
        return self.run.calibration

    def without_path(self) -> FinishedJob:
        """The same with a config that names no drive, because its drive was a copy."""
        nowhere = self.config.data.model_copy(update={"path": None})
        return replace(self, config=self.config.model_copy(update={"data": nowhere}))

    def write(self, folder: Path) -> None:
        """Writes all files of the result into an empty folder.

        Raises:
            OSError: a file cannot be written.
            OutputError: a file cannot be written.
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
    """Opens the drives of a job; without `data`, the one at `data.path` of the config.

    Raises:
        ConfigError: a drive is given twice, or there is none.
        RecordingError: a drive is missing, incomplete or inconsistent, or two are of the same time
            and have one file of poses.
    """
    each_once(data, "--data ", "a drive")
    recordings = [open_recording(config, path) for path in data or (None,)]
    if config.data.poses is not None:
        _check_times_apart(recordings, config.data.poses)
    return recordings


def _check_times_apart(recordings: Sequence[Recording], poses: Path) -> None:
    """Refuses drives of the same time: the file's poses at that time are of one of them."""
    spans = []
    for recording in recordings:
        stamps = [s for name in recording.lidars for s in recording.scan_stamps_ns(name)]
        if stamps:
            spans.append((min(stamps), max(stamps), recording.name))
    spans.sort()
    for (_, end, one), (begin, _, other) in pairwise(spans):
        if begin <= end:
            raise RecordingError(
                f"{poses}: poses of one vehicle, but the clouds of '{one}' and '{other}' are of "
                f"the same time ({begin / 1e9:.3f} s): perhaps their times count from the start of "
                "each drive. Calibrate each with a config and poses of its own, and join the "
                "results with 'caliv-graph merge'"
            )


def guess_problem(config: Config, path: Path) -> str:
    """A sentence on a config, read from `path`, whose guesses are all zeros; or nothing.

    Two LiDARs have zeros, as drafts of older versions had for unknown guesses.
    """
    zeros = _zeros(config)
    if not zeros:
        return ""
    fields = " and ".join(f"lidars.{name}.initial" for name in zeros)
    return (
        f"{path}: {fields} are all zeros, but two LiDARs cannot be in the same place. Enter xyz in "
        "metres and rpy_deg in degrees from a tape measure or a drawing (errors of 0.1 m and 3 "
        "degrees are fine), or 'initial: null': then they are found from the drive"
    )


def without_zeros(config: Config) -> Config:
    """The config without the guesses that `guess_problem` names: they are unknown."""
    unknown = {
        name: config.lidars[name].model_copy(update={"initial": None}) for name in _zeros(config)
    }
    return config.model_copy(update={"lidars": {**config.lidars, **unknown}})


def _zeros(config: Config) -> list[str]:
    """LiDARs whose guess is all zeros, if they are more than one."""
    unknown = PoseConfig(xyz=(0.0, 0.0, 0.0))
    zeros = [name for name, lidar in config.lidars.items() if lidar.initial == unknown]
    return zeros if len(zeros) > 1 else []


def check_guesses(config: Config, path: Path) -> None:
    """Refuses a config, read from `path`, in which the guesses of two LiDARs are zeros.

    Raises:
        ConfigError: see `guess_problem`.
    """
    problem = guess_problem(config, path)
    if problem:
        raise ConfigError(problem)


def run_job(
    recordings: Sequence[Recording],
    config: Config,
    progress: SilentProgress,
    prior: Calibration | None = None,
) -> FinishedJob:
    """Calibrates, and collects all warnings.

    Raises:
        CalivError: the input is invalid or insufficient.
    """
    # Imported here: batch inspects jobs without the estimator.
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
            *calibration.warnings,
            *calibration.unmet,
        ),
    )


def _unused_keys(config: Config) -> list[str]:
    """A line per section, or topic of a bag, that is set and has no effect."""
    if config.data.format == "rosbag":
        named = [key for key, topic in config.topics if topic is not None and key != "pose"]
        source = "data.poses" if config.data.poses is not None else "topics.pose"
        return [
            f"topics.{key}: has no effect on the trajectory, since {source} stands instead. Remove "
            "one of the two"
            for key in named
            if config.names_poses()
        ]
    what = (
        "a CaLiV folder contains the vehicle poses"
        if config.data.format == "caliv"
        else "folders of clouds have no topics but data.poses"
    )
    sections = {"topics": config.topics, "imu": config.imu, "gnss": config.gnss}
    return [
        f"{name}: has no effect, since {what}"
        for name, section in sections.items()
        if section != type(section)()
    ]
