"""Memory does not grow with the bag: a drive seven times as long, each in a process of its own."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import pytest

from caliv_graph.common.progress import SilentProgress
from scripts import benchmark_bag

ROOT = Path(__file__).resolve().parents[1]

MOST_MB = 44.0
"""That three more minutes may take, a quarter of what their clouds are in the bag: samples of the
IMU, and a pose every tenth of a second for the first two minutes, every half a second from then on.
It is 20 MB on a quiet machine, 33 on a busy one, where arenas of threads come and go."""

# All that depends on the length of a drive: first pass, trajectory, clouds, ground.
_STAGES = """
import json, os, sys
from pathlib import Path
from caliv_graph.config.load import load_config
from caliv_graph.common.progress import SilentProgress
from caliv_graph.readers import open_recording
from caliv_graph.readers.sampled import SampledRecording
from caliv_graph.targets import extract_targets
from caliv_graph.targets.ground.measure import measure_grounds
from caliv_graph.trajectory.select import smooth_trajectories

def measure(path):
    config = load_config(Path(path))
    recordings = [SampledRecording(open_recording(config))]
    motions = {0: recordings[0].motion()}
    trajectories = smooth_trajectories(recordings, config, [[]], motions)
    observations = extract_targets(recordings, trajectories, config, SilentProgress())
    grounds, _ = measure_grounds(recordings, trajectories, observations, config, SilentProgress())
    status = dict(line.split(":") for line in open("/proc/self/status") if ":" in line)
    print(json.dumps({
        "peak_mb": int(status["VmHWM"].split()[0]) / 1024,
        "clouds": sum(len(o.clouds) for o in observations), "grounds": len(grounds),
    }), flush=True)

for path in sys.argv[1:]:
    child = os.fork()  # what was imported is in both alike
    if not child:
        measure(path)
        os._exit(0)
    assert not os.waitpid(child, 0)[1]
"""


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads Linux's /proc")
def test_a_drive_of_seven_times_the_length_takes_hardly_more_memory(tmp_path: Path) -> None:
    sizes_mb, configs = [], []
    for minutes in (0.5, 3.5):
        folder = tmp_path / f"{minutes:g}"
        folder.mkdir()
        asked = argparse.Namespace(minutes=minutes, lidars=1, points=6000, zstd=False, search=False)
        recording = benchmark_bag.LapsRecording(benchmark_bag.scenario_of(asked), 1, 1)
        sizes_mb.append(benchmark_bag.write_laps(recording, folder, SilentProgress()))
        config = folder / "config.yaml"
        # A cloud this sparse has few points on a chair.
        few = "extraction: {min_points: 12}\n"
        config.write_text(config.read_text(encoding="utf-8") + few, encoding="utf-8")
        configs.append(str(config))
    done = subprocess.run(
        [sys.executable, "-c", _STAGES, *configs],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )

    short_mb, long_mb = sizes_mb
    short, long = map(json.loads, done.stdout.splitlines())
    assert long_mb - short_mb > 160.0
    assert min(short["clouds"], short["grounds"]) > 20
    assert min(long["clouds"], long["grounds"]) > 20
    assert long["peak_mb"] - short["peak_mb"] < MOST_MB
