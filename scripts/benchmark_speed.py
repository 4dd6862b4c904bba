"""Time of a calibration by stage, and its growth with the data.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/benchmark_speed.py

Every calibration is `caliv-graph calibrate` in its own process, report and files included. It is
timed from the end of its imports; start-up is measured separately. Memory is that of the whole
process. Bags are simulated with `--seed` into a temporary folder and deleted. Measured are

- the drive that the CaLiV authors published (`--data`) and simulated bags, on 2 cores and on 1:
  each stage, the rest (first pass over a bag, report, files), and peak memory;
- how processor time grows with clouds, points per cloud, LiDARs and components of the mixture,
  each 1, 2 and 4 times, LiDARs 8 times as well;
- `caliv-graph inspect --config` of the last of these bags: on 2 cores and on 1, and how its
  processor time grows while four other processes are busy;
- the paper's own estimator, reimplemented (`benchmark_paper.py`), on the same clouds from the same
  guesses in the same process as ours, one thread each: end to end, and the optimisation alone;
- `--help` of the program and of every command.

Growth and ratios use processor time, because wall time depends on other processes.
`--quick` leaves out all repetitions, the larger bag and the paper's estimator on it. `--profile`
measures nothing of this: it prints where the processor time of three calibrations goes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one thread for both estimators
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the scripts beside this one from any folder

from caliv_graph._open3d import import_open3d
from caliv_graph.common.memory import keep_freed_memory
from caliv_graph.common.progress import PlainProgress, Progress, SilentProgress
from caliv_graph.config.load import dump_config, load_config
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, ConfigError
from caliv_graph.readers import open_recording
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.recording import SimulatedRecording
from scripts import _child, benchmark_bag, benchmark_paper
from scripts import benchmark_released as released
from scripts._command import positive
from scripts._profile import Profile, profile_text, profiled
from scripts._structure_rows import shipped
from scripts._tables_rows import config_for
from scripts._thinned import GroundWaves, ThinnedRecording, cached_selection

BAGS = ("demo_arc", "figure_eight")
QUICK_BAGS = ("demo_arc",)
REPEATED = 3
CORES = (2, 1)

CLOUD_STEPS = (4, 2, 1)
"""Subsampling of the clouds of the authors' drive: every n-th cloud."""

POINTS = (12_000, 24_000, 48_000)
LIDARS = (1, 2, 4, 8)
COMPONENTS = (300, 600, 1200)
MOST_COMPONENTS = 1000
"""Numbers of components to which the limit applies, besides 300."""

MINUTES = 1.0
"""Duration of the bags with varying points and LiDARs: one figure-eight."""

READING = ("reading clouds", "reading the ground")

OTHERS = 4
"""Processes that are busy beside `inspect`."""

TOTAL_LIMIT_S = 4.0
READING_LIMIT_S = 3.0
READINGS_LIMIT = 8.0
"""Of the whole over reading clouds and cutting the target out of them."""

SECOND_CORE_LIMIT = 1.0
OTHERS_LIMIT = 1.3
PAPER_LIMIT = 3.0
"""Of the paper's estimator over ours, end to end, at least."""

DOUBLE_LIMIT = 2.2
LINEAR_LIMIT = 1.15
COMPONENTS_LIMIT = 2.0
HELP_LIMIT_S = 0.4
COMMANDS = (
    *("init", "simulate", "inspect", "observability", "plan", "calibrate"),
    *("evaluate", "validate", "compare", "merge", "export"),
)


@dataclass(frozen=True)
class Case:
    """One drive, calibrated on some numbers of cores.

    Attributes:
        name: its name.
        clouds: number of clouds in the recording.
        usages: resources by number of cores.
    """

    name: str
    clouds: int
    usages: Mapping[int, _child.Usage]


@dataclass(frozen=True)
class Growth:
    """Growth of a calibration's time with one quantity.

    Attributes:
        what: the quantity.
        sizes: its values.
        usages: resources for each value, on one core.
    """

    what: str
    sizes: tuple[int, ...]
    usages: tuple[_child.Usage, ...]

    def ratios(self) -> tuple[float, ...]:
        """Processor times relative to the first."""
        return tuple(usage.cpu_s / self.usages[0].cpu_s for usage in self.usages)

    def over_linear(self) -> float:
        """Largest processor time relative to one in proportion to the size."""
        pairs = zip(self.sizes, self.ratios(), strict=True)
        return max(ratio * self.sizes[0] / size for size, ratio in pairs)

    def doubled(self) -> float:
        """Processor time of the last relative to the one before."""
        return self.usages[-1].cpu_s / self.usages[-2].cpu_s


@dataclass(frozen=True)
class Baseline:
    """The paper's estimator and ours on the same clouds.

    Attributes:
        name: of the drive.
        paper: seconds of its `total`, `cpu`, `registration` and `optimisation`.
        ours: likewise.
    """

    name: str
    paper: Mapping[str, float]
    ours: Mapping[str, float]


@dataclass(frozen=True)
class Inspection:
    """`inspect --config` of a bag.

    Attributes:
        name: of the drive.
        walls_s: from the end of the imports, by number of cores.
        cpu_s: processor time on all of these, nothing else busy.
        busy_cpu_s: the same while others are busy.
    """

    name: str
    walls_s: Mapping[int, float]
    cpu_s: float
    busy_cpu_s: float


@dataclass(frozen=True)
class Verdict:
    """A limit, and whether it is kept."""

    what: str
    value: float
    limit: float
    unit: str
    at_least: bool = False

    @property
    def kept(self) -> bool:
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True)
class Found:
    """All measurements.

    Attributes:
        cases: drives, stage by stage.
        growths: by quantity.
        more_components: processor time with 1,000 components relative to 300; None: not measured.
        inspection: of a bag.
        baselines: the paper's estimator and ours.
        helps_s: wall time of `--help` by command.
        load: load average before the start. It makes wall times longer.
    """

    cases: tuple[Case, ...]
    growths: tuple[Growth, ...]
    more_components: float | None
    inspection: Inspection
    baselines: tuple[Baseline, ...]
    helps_s: Mapping[str, float]
    load: float


def main() -> int:
    arguments = parse_arguments()
    progress = SilentProgress() if arguments.json else PlainProgress(say)
    try:
        with tempfile.TemporaryDirectory(prefix="caliv_speed_", dir=arguments.folder) as name:
            if arguments.profile:
                show_profiles(arguments, Path(name), progress)
                return 0
            found = benchmark(arguments, Path(name), progress)
    except (CalivError, OSError) as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        return 130
    limits = verdicts(found)
    if arguments.json:
        say(json.dumps(document(arguments, found, limits), indent=2))
    else:
        say(f"\n{text(found, limits)}")
    return 0 if all(verdict.kept for verdict in limits) else 3


def parse_arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Times calibrations stage by stage, and how they grow with clouds, points, "
        "LiDARs and components; beside the paper's own estimator.",
        epilog="Exit codes: 0 all limits are kept; 3 one is not; 2 it could not be tried.",
    )
    parser.add_argument(
        "--data",
        type=Path,
        default=REPOSITORY / "../shared/data/caliv_released",
        help="the authors' drive (default: ../shared/data/caliv_released beside the repository); "
        "what needs it is left out, and said, where it is not there",
    )
    parser.add_argument("--seed", type=positive, default=1, help="default: 1")
    parser.add_argument("--folder", type=Path, help="for temporary files (default: the system's)")
    parser.add_argument("--quick", action="store_true", help="less of everything, in minutes")
    parser.add_argument(
        "--profile",
        action="store_true",
        help="print the processor time of three calibrations by stage and by function: the "
        "authors' drive, figure_eight from raw sensors in memory, yard with structure",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    return parser.parse_args(given)


def show_profiles(arguments: argparse.Namespace, folder: Path, progress: Progress) -> None:
    """Prints where the processor time of three calibrations goes."""
    profiles = list(profiles_of(arguments, folder, progress))
    if arguments.json:
        say(json.dumps([vars(profile) for profile in profiles], indent=2))
    else:
        say("\n\n".join(["", *map(profile_text, profiles)]))


def profiles_of(
    arguments: argparse.Namespace, folder: Path, progress: Progress
) -> Iterator[Profile]:
    """The authors' drive; a run of the tables; and one of whole clouds with structure.

    The last two cast the rays of their clouds while these are read: the room `simulation`.
    """
    import_open3d()
    keep_freed_memory()  # as the program does
    data = arguments.data.resolve()
    if (data / "input").is_dir():
        config = load_config(authors(data, folder))
        with progress.stage("profiling: authors' drive"):
            yield profiled("authors' drive", open_recording(config), config)
    scenario = load_scenario(REPOSITORY / "configs/scenarios/figure_eight.yaml")
    selection = cached_selection(scenario, folder, progress=progress)
    thinned = ThinnedRecording(scenario, selection, arguments.seed, waves=GroundWaves())
    for name, recording in (
        ("figure_eight, a run of the tables", thinned),
        ("yard, walls and ground", SimulatedRecording(shipped("yard"), arguments.seed)),
    ):
        with progress.stage(f"profiling: {name}"):
            yield profiled(name, recording, config_for(recording, {}))


def benchmark(arguments: argparse.Namespace, folder: Path, progress: Progress) -> Found:
    load = os.getloadavg()[0]
    repeated = 1 if arguments.quick else REPEATED
    names = QUICK_BAGS if arguments.quick else BAGS
    data = arguments.data.resolve()
    has_data = (data / "input").is_dir()
    if not has_data:
        print(f"{data}: is not there: the authors' drive is left out", file=sys.stderr)
    bags = {name: simulated(name, arguments.seed, folder, progress) for name in names}
    drives = {"authors' drive": authors(data, folder)} if has_data else {}
    drives |= bags
    cases = []
    for name, config in drives.items():
        with progress.stage(f"calibrating: {name}", len(CORES) * repeated) as advance:
            usages = {cores: timed(config, cores, repeated, advance) for cores in CORES}
        cases.append(Case(name, cloud_count(config), usages))
    growths = []
    more_components = None
    if has_data:
        growths.append(with_clouds(data, folder, repeated, progress))
        of_components, more_components = with_components(data, folder, repeated, progress)
        growths.append(of_components)
    growths += [
        with_bags("points per cloud", POINTS, arguments, folder, progress),
        with_bags("LiDARs", LIDARS, arguments, folder, progress),
    ]
    inspection = inspected(names[-1], bags[names[-1]], repeated, progress)
    baselines = []
    if has_data:
        job = benchmark_paper.Job(
            "authors' drive", 1, benchmark_paper.published(data, arguments.seed)
        )
        baselines.append(beside(job, progress))
    if not arguments.quick:
        for name in names[-1:]:
            opened = benchmark_paper.simulated(name, arguments.seed)
            baselines.append(beside(benchmark_paper.Job(name, arguments.seed, opened), progress))
    with progress.stage("asking for help"):
        helps = {"caliv-graph": _child.help_s([], 5)}
        helps |= {command: _child.help_s([command], 3) for command in COMMANDS}
    growth = tuple(growths)
    return Found(tuple(cases), growth, more_components, inspection, tuple(baselines), helps, load)


def timed(config: Path, cores: int, repeated: int, advance: Callable[[], object]) -> _child.Usage:
    """The median of some calibrations."""
    usages = []
    for _ in range(repeated):
        usages.append(_child.calibrate(config, config.parent / "result", cores))
        advance()
    return _child.middle(usages)


def inspected(name: str, config: Path, repeated: int, progress: Progress) -> Inspection:
    """`inspect --config`, the median of some runs of each kind, in turn."""
    asked = ["inspect", str(config.parent / "drive"), "--config", str(config)]
    walls: dict[int, list[float]] = {cores: [] for cores in CORES}
    cpus: list[float] = []
    busy: list[float] = []
    with progress.stage(f"inspecting {name}", (len(CORES) + 1) * repeated) as advance:
        for _ in range(repeated):
            for cores in CORES:
                usage = inspect_once(asked, cores)
                walls[cores].append(usage["wall_s"])
                if cores == CORES[0]:
                    cpus.append(usage["cpu_s"])
                advance()
            with busy_processes(OTHERS):
                busy.append(inspect_once(asked, CORES[0])["cpu_s"])
            advance()
    by_cores = {cores: statistics.median(of_cores) for cores, of_cores in walls.items()}
    return Inspection(name, by_cores, statistics.median(cpus), statistics.median(busy))


def inspect_once(asked: Sequence[str], cores: int) -> Mapping[str, float]:
    """Times of `inspect`.

    Raises:
        CalivError: it could not look at the drive.
    """
    code, usage = _child.run(asked, cores)
    if code != 0:
        raise CalivError(f"caliv-graph {' '.join(asked)}: exit code {code}")
    return usage


@contextmanager
def busy_processes(count: int) -> Iterator[Sequence[subprocess.Popen[bytes]]]:
    """Keeps so many other processes computing."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield others
    finally:
        for other in others:
            other.kill()
            other.wait()


def cloud_count(config: Path) -> int:
    """Clouds in the recording of a config."""
    recording = open_recording(load_config(config))
    return sum(len(recording.scan_stamps_ns(lidar)) for lidar in recording.lidars)


def simulated(name: str, seed: int, folder: Path, progress: Progress) -> Path:
    """Config of a simulated bag."""
    scenario, out = REPOSITORY / f"configs/scenarios/{name}.yaml", folder / name
    with progress.stage(f"simulating {name}"):
        _child.run(["simulate", str(scenario), "--out", str(out), "--seed", str(seed)], 0)
    return out / "config.yaml"


def authors(data: Path, folder: Path, **registration: Any) -> Path:
    """Config of the authors' drive, with the guesses that the repository's config has."""
    config = load_config(released.CONFIG)
    if not (data / "input").is_dir():
        raise ConfigError(f"{data}: the drive that the CaLiV authors published is not there")
    settings = config.registration.model_copy(update=registration)
    where = config.data.model_copy(update={"path": data})
    return written(config.model_copy(update={"registration": settings, "data": where}), folder)


def written(config: Config, folder: Path) -> Path:
    path = Path(tempfile.mkdtemp(dir=folder)) / "config.yaml"
    path.write_text(dump_config(config), encoding="utf-8")
    return path


def with_clouds(data: Path, folder: Path, repeated: int, progress: Progress) -> Growth:
    """The authors' drive with every fourth of its clouds, every second, and all."""
    sizes, usages = [], []
    with progress.stage("growth with clouds", len(CLOUD_STEPS) * repeated) as advance:
        for step in CLOUD_STEPS:
            config = authors(part_of(data, step, folder), folder)
            sizes.append(cloud_count(config))
            usages.append(timed(config, 1, repeated, advance))
    return Growth("clouds of the authors' drive", tuple(sizes), tuple(usages))


def part_of(data: Path, step: int, folder: Path) -> Path:
    """A CaLiV folder with links to every n-th cloud of another one."""
    part = Path(tempfile.mkdtemp(dir=folder))
    (part / "input").mkdir()
    poses = data / "input/ego_poses.yaml"
    (part / "input/ego_poses.yaml").write_bytes(poses.read_bytes())
    for sensor in sorted(entry for entry in (data / "input").iterdir() if entry.is_dir()):
        (part / "input" / sensor.name).mkdir()
        clouds = sorted(sensor.glob("*.pcd"), key=lambda path: int(path.stem))
        for cloud in clouds[::step]:
            (part / "input" / sensor.name / cloud.name).symlink_to(cloud.resolve())
    return part


def with_components(
    data: Path, folder: Path, repeated: int, progress: Progress
) -> tuple[Growth, float]:
    """The authors' drive with mixtures of several sizes; and 1,000 components over 300."""
    counts = sorted({*COMPONENTS, MOST_COMPONENTS})
    usages = {}
    with progress.stage("growth with components", len(counts) * repeated) as advance:
        for count in counts:
            config = authors(data, folder, components=count)
            usages[count] = timed(config, 1, repeated, advance)
    growth = Growth(
        "components, authors' drive", COMPONENTS, tuple(usages[count] for count in COMPONENTS)
    )
    return growth, usages[MOST_COMPONENTS].cpu_s / usages[COMPONENTS[0]].cpu_s


def with_bags(
    what: str,
    sizes: tuple[int, ...],
    arguments: argparse.Namespace,
    folder: Path,
    progress: Progress,
) -> Growth:
    """Bags of one figure-eight, with several numbers of points or of LiDARs."""
    usages = []
    for size in sizes:
        model = argparse.Namespace(
            minutes=MINUTES,
            lidars=size if what == "LiDARs" else 2,
            points=POINTS[0] if what == "LiDARs" else size,
            zstd=False,
            search=False,
        )
        recording = benchmark_bag.LapsRecording(
            benchmark_bag.scenario_of(model), arguments.seed, len(os.sched_getaffinity(0))
        )
        with tempfile.TemporaryDirectory(dir=folder) as name:
            benchmark_bag.check_disk(recording, model.points, Path(name))
            benchmark_bag.write_laps(recording, Path(name), SilentProgress())
            with progress.stage(f"growth with {what}: {size}") as advance:
                usages.append(timed(Path(name) / "config.yaml", 1, 1, advance))
    return Growth(f"{what}, a figure-eight", sizes, tuple(usages))


def beside(job: benchmark_paper.Job, progress: Progress) -> Baseline:
    """Both estimators on the same clouds from the same guess.

    Raises:
        CalivError: one of them has no result.
    """
    import_open3d()  # takes a second that is part of neither estimator
    recording, config, truth = job.open()
    outcomes = {}
    for estimator in (benchmark_paper.PAPER, benchmark_paper.OURS):
        with progress.stage(f"{job.drive}: {estimator}"):
            outcome = benchmark_paper.run_once(job, "guess", estimator, recording, config, truth)
        if outcome.failure:
            raise CalivError(f"{job.drive}, {estimator}: {outcome.failure}")
        outcomes[estimator] = outcome.seconds
    return Baseline(job.drive, outcomes[benchmark_paper.PAPER], outcomes[benchmark_paper.OURS])


def verdicts(found: Found) -> list[Verdict]:
    """The project's limits and the measured values."""
    out = []
    for case in found.cases:
        if case.name == "authors' drive":
            usage = case.usages[CORES[0]]
            reading_s = usage.stage_s(*READING)
            readings = usage.wall_s / reading_s
            out += [
                Verdict(f"{case.clouds} clouds, 2 cores, wall", usage.wall_s, TOTAL_LIMIT_S, "s"),
                Verdict("of which reading", reading_s, READING_LIMIT_S, "s"),
                Verdict("over reading and cutting out", readings, READINGS_LIMIT, "times as long"),
            ]
    for growth in found.growths:
        if growth.what.startswith("clouds"):
            out.append(
                Verdict("twice the clouds, CPU", growth.doubled(), DOUBLE_LIMIT, "times as much")
            )
        if growth.what.startswith("LiDARs"):
            out.append(
                Verdict("more LiDARs, CPU", growth.over_linear(), LINEAR_LIMIT, "times linear")
            )
    if found.more_components is not None:
        what = f"{MOST_COMPONENTS} components against {COMPONENTS[0]}, CPU"
        out.append(Verdict(what, found.more_components, COMPONENTS_LIMIT, "times as much"))
    looked = found.inspection
    second = looked.walls_s[CORES[0]] / looked.walls_s[CORES[-1]]
    grown = looked.busy_cpu_s / looked.cpu_s
    out += [
        Verdict("inspect, 2 cores against 1, wall", second, SECOND_CORE_LIMIT, "times as long"),
        Verdict(f"inspect beside {OTHERS} processes, CPU", grown, OTHERS_LIMIT, "times as much"),
    ]
    for baseline in found.baselines:
        ratio = baseline.paper["total"] / max(baseline.ours["total"], 1e-9)
        what = f"the paper's estimator, {baseline.name}"
        out.append(Verdict(what, ratio, PAPER_LIMIT, "times as long", at_least=True))
    slowest = max(found.helps_s, key=lambda name: found.helps_s[name])
    out.append(Verdict(f"--help, slowest ({slowest})", found.helps_s[slowest], HELP_LIMIT_S, "s"))
    return out


def text(found: Found, limits: Sequence[Verdict]) -> str:
    """The result for a person."""
    parts = [*map(case_text, found.cases)]
    parts += ["\n".join(["Growth, CPU on one core", *map(growth_text, found.growths)])]
    parts.append(inspection_text(found.inspection))
    parts += map(baseline_text, found.baselines)
    lines = ["Limits"]
    if found.load > 0.5:
        lines.append(
            f"  (others kept {found.load:.1f} cores busy when this began: wall times are longer)"
        )
    for verdict in limits:
        kept = "kept" if verdict.kept else "MISSED"
        asked = f"at {'least' if verdict.at_least else 'most'} {verdict.limit:g}"
        lines.append(f"  {verdict.what:42}{verdict.value:8.2f} {verdict.unit}, {asked}: {kept}")
    return "\n\n".join([*parts, "\n".join(lines)])


def case_text(case: Case) -> str:
    """Stages in rows, cores in columns."""
    lines = [f"{case.name}: {case.clouds} clouds", f"  {'seconds':48}"]
    headings = {n: f"{n} cores" if n > 1 else "1 core" for n in case.usages}
    lines[-1] += "".join(f"{heading:>10}{'CPU':>8}" for heading in headings.values())
    stages = dict.fromkeys(name for usage in case.usages.values() for name in usage.stages)
    nothing = (0.0, 0.0)
    for name in stages:
        cells = [usage.stages.get(name, nothing) for usage in case.usages.values()]
        lines.append(f"  {name:48}" + "".join(f"{wall:10.2f}{cpu:8.2f}" for wall, cpu in cells))
    rests = [rest(usage) for usage in case.usages.values()]
    lines.append(
        f"  {'first pass over a bag, tests, report, files':48}"
        + "".join(f"{wall:10.2f}{cpu:8.2f}" for wall, cpu in rests)
    )
    lines.append(
        f"  {'all after start-up':48}"
        + "".join(f"{usage.wall_s:10.2f}{usage.cpu_s:8.2f}" for usage in case.usages.values())
    )
    usage = case.usages[CORES[0]]
    reading = usage.stage_s(*READING)
    lines.append(
        f"  reading and cutting out: {100 * reading / usage.wall_s:.0f} percent; start-up "
        f"{usage.start_up_cpu_s:.2f} s of CPU; peak memory {usage.peak_mb:.0f} MB"
    )
    return "\n".join(lines)


def rest(usage: _child.Usage) -> tuple[float, float]:
    """Wall and processor time outside all stages."""
    walls, cpus = zip(*usage.stages.values(), strict=True)
    return usage.wall_s - sum(walls), usage.cpu_s - sum(cpus)


def growth_text(growth: Growth) -> str:
    cells = [
        f"{size}: {usage.cpu_s:.1f} s, {usage.peak_mb:.0f} MB ({ratio:.2f}x)"
        for size, usage, ratio in zip(growth.sizes, growth.usages, growth.ratios(), strict=True)
    ]
    return f"  {growth.what:36}{'; '.join(cells)}"


def inspection_text(inspection: Inspection) -> str:
    walls = ", ".join(
        f"{wall:.1f} s on {n} core{'s' if n > 1 else ''}" for n, wall in inspection.walls_s.items()
    )
    return (
        f"inspect --config, {inspection.name}\n  {walls}; {inspection.cpu_s:.1f} s of CPU, "
        f"{inspection.busy_cpu_s:.1f} s beside {OTHERS} busy processes"
    )


def baseline_text(baseline: Baseline) -> str:
    lines = [f"The paper's estimator, written anew, and ours: {baseline.name}"]
    lines.append(f"  {'seconds, one thread':30}{'paper':>9}{'ours':>9}{'ratio':>9}")
    for name, label in benchmark_paper.TIMES.items():
        paper, ours = baseline.paper[name], baseline.ours[name]
        lines.append(f"  {label:30}{paper:9.2f}{ours:9.2f}{paper / max(ours, 1e-9):9.2f}")
    return "\n".join(lines)


def document(
    arguments: argparse.Namespace, found: Found, limits: Sequence[Verdict]
) -> dict[str, Any]:
    """Everything as plain values, seconds and MB."""
    return {
        "seed": arguments.seed,
        "quick": arguments.quick,
        "cases": [
            {
                "name": case.name,
                "clouds": case.clouds,
                "by_cores": {str(n): usage_document(u) for n, u in case.usages.items()},
            }
            for case in found.cases
        ],
        "growth": [
            {
                "what": growth.what,
                "sizes": list(growth.sizes),
                "usages": [usage_document(usage) for usage in growth.usages],
                "cpu_ratios": list(growth.ratios()),
            }
            for growth in found.growths
        ],
        "components_1000_over_300": found.more_components,
        "inspect": {
            "name": found.inspection.name,
            "wall_s_by_cores": {str(n): wall for n, wall in found.inspection.walls_s.items()},
            "cpu_s": found.inspection.cpu_s,
            "cpu_s_beside_busy_processes": found.inspection.busy_cpu_s,
        },
        "paper": [
            {
                "drive": baseline.name,
                "paper_s": dict(baseline.paper),
                "ours_s": dict(baseline.ours),
            }
            for baseline in found.baselines
        ],
        "help_s": dict(found.helps_s),
        "load_before": found.load,
        "limits": [{**vars(verdict), "kept": verdict.kept} for verdict in limits],
    }


def usage_document(usage: _child.Usage) -> dict[str, Any]:
    return {
        "wall_s": usage.wall_s,
        "cpu_s": usage.cpu_s,
        "start_up_cpu_s": usage.start_up_cpu_s,
        "peak_mb": usage.peak_mb,
        "stages": {
            name: {"wall_s": wall, "cpu_s": cpu} for name, (wall, cpu) in usage.stages.items()
        },
    }


def say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
