"""Whether the same input, config and seed give the same bytes, on one core and on two.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/check_reproducible.py

Calibrates the drive that the CaLiV authors published (../shared/data/caliv_released, or `--config`
with `--data`) in processes that differ in what must not matter: the number of cores, the number of
threads of BLAS and OpenMP, the seed of Python's hashes, the current folder, and a second run.
Prints the digest of calibration.yaml and the time of each. The exit code is 1 if they differ. With
`--scenario` the drive is first simulated twice and compared as well. The date in a calibration.yaml
is left out.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RELEASED = ROOT.parent / "shared" / "data" / "caliv_released"

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS")

STAMPS = ("stamp", "created", "date")
"""Keys of the provenance that may differ from run to run."""


@dataclass(frozen=True)
class Setting:
    """A setting that must not change the result.

    Attributes:
        name: for the table.
        cores: that the process may use.
        threads: value of `THREADS`; None: not set.
        hash_seed: seed of Python's hashes.
        elsewhere: whether the current folder is another one.
    """

    name: str
    cores: int
    threads: int | None
    hash_seed: str = "0"
    elsewhere: bool = False


SETTINGS = (
    Setting("1 core, 1 thread", 1, 1),
    Setting("the same again, other hashes", 1, 1, hash_seed="12345", elsewhere=True),
    Setting("1 core, threads not set", 1, None, hash_seed="random"),
    Setting("2 cores, 1 thread", 2, 1, hash_seed="random"),
    Setting("2 cores, 2 threads", 2, 2),
    Setting("2 cores, threads not set", 2, None),
)


@dataclass
class Found:
    """Result of a setting: digest per file, and seconds."""

    digests: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "caliv_released.yaml")
    parser.add_argument("--data", type=Path, help="the drive; default: that of the config")
    parser.add_argument("--scenario", type=Path, help="simulate this drive, instead of --config")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args(arguments)
    if options.scenario is None and options.data is None:
        options.data = RELEASED
        if not RELEASED.is_dir():
            print(f"skipped: {RELEASED} is not there. Give --config and --data, or --scenario")
            return 0
    found: dict[str, Found] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, setting in enumerate(SETTINGS):
            if setting.cores > len(os.sched_getaffinity(0)):
                print(f"{setting.name}: left out, for want of cores", file=sys.stderr)
                continue
            place = Path(folder) / str(number)
            place.mkdir()
            found[setting.name] = run(setting, place, options)
            if not options.json:
                print(line(setting.name, found[setting.name]), flush=True)
    same = all(result.digests == next(iter(found.values())).digests for result in found.values())
    if options.json:
        print(json.dumps({"same": same, "runs": {n: vars(f) for n, f in found.items()}}, indent=2))
    else:
        print("the same bytes in all of them" if same else "THEY DIFFER")
    return int(not same)


def line(name: str, found: Found) -> str:
    digests = "  ".join(f"{file} {digest[:12]}" for file, digest in found.digests.items())
    return f"{name:<30} {found.seconds:5.1f} s  {digests}"


def run(setting: Setting, place: Path, options: argparse.Namespace) -> Found:
    found = Found()
    config, data = options.config, options.data
    if options.scenario is not None:
        drive = place / "drive"
        arguments = ["simulate", options.scenario.resolve(), "--out", drive]
        command(setting, place, [*arguments, "--seed", options.seed, "--format", "both"])
        found.digests = {
            "drive": digest_of(*sorted(path for path in drive.rglob("*") if path.is_file()))
        }
        config, data = drive / "config.yaml", None
    arguments = ["calibrate", config.resolve(), "--out", place / "result"]
    if data is not None:
        arguments += ["--data", data.resolve()]
    start = time.monotonic()
    command(setting, place, arguments)
    found.seconds = time.monotonic() - start
    result = place / "result"
    found.digests["calibration.yaml"] = without_stamp(result / "calibration.yaml")
    found.digests["target.ply"] = digest_of(result / "target.ply")
    return found


def command(setting: Setting, place: Path, arguments: Sequence[object]) -> None:
    """Runs the program with a setting.

    Raises:
        RuntimeError: it failed.
    """
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    environment |= {"PYTHONHASHSEED": setting.hash_seed, "PYTHONPATH": str(ROOT)}
    if setting.threads is not None:
        environment |= dict.fromkeys(THREADS, str(setting.threads))
    cores = sorted(os.sched_getaffinity(0))[: setting.cores]
    done = subprocess.run(
        [sys.executable, "-m", "caliv_graph", *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment,
        cwd=place if setting.elsewhere else ROOT,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    if done.returncode not in (0, 3, 4):
        raise RuntimeError(f"{' '.join(map(str, arguments))}: {done.stderr}")


def without_stamp(path: Path) -> str:
    """Digest of a calibration.yaml without its date."""
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = [text for text in lines if text.strip().partition(":")[0] not in STAMPS]
    return hashlib.sha256("\n".join(kept).encode()).hexdigest()


def digest_of(*paths: Path) -> str:
    found = hashlib.sha256()
    for path in paths:
        found.update(path.name.encode())
        found.update(path.read_bytes())
    return found.hexdigest()


if __name__ == "__main__":
    sys.exit(main())
