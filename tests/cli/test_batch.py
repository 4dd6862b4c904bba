"""`caliv-graph batch` as a shell sees it: real drives, real workers, real deaths."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from caliv_graph.batch import cluster
from caliv_graph.results.calibration_file import read_calibration
from tests.batch.tiny import tiny_drive
from tests.cli.commands import ROOT, called

PATIENCE_S = 120.0

STAMPED = ("job.json", "log.jsonl", "report.html")
"""Files of a result that say when it was made, or how long that took."""


def launch(*arguments: object) -> subprocess.Popen[str]:
    """Starts `batch` in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "caliv_graph", "batch", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        start_new_session=True,
    )


def batch(*arguments: object) -> subprocess.CompletedProcess[str]:
    process = launch(*arguments)
    try:
        out, err = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def wait_for(what: Callable[[], Any]) -> Any:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found = what()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError("it did not come")


def worker_of(out: Path, job: str, attempt: int = 1) -> int:
    """Process that has taken up a job; waits for it."""

    def pid() -> int:
        for file in out.glob(f".work/*/{job}.attempt-{attempt}"):
            try:
                return int(json.loads(file.read_text())["pid"])
            except (ValueError, OSError):
                continue
        return 0

    return int(wait_for(pid))


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def write_manifest(path: Path, *jobs: dict[str, Any], **sections: Any) -> Path:
    path.write_text(yaml.safe_dump({**sections, "jobs": list(jobs)}))
    return path


def contents(out: Path) -> dict[str, bytes]:
    """Files of all results that are the same whenever they are made."""
    return {
        str(file.relative_to(out)): file.read_bytes()
        for file in sorted(out.glob("[!.]*/*"))
        if file.name not in STAMPED
    }


def records(out: Path) -> dict[str, str]:
    return {file.parent.name: file.read_text() for file in out.glob("*/job.json")}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of a vehicle, and a manifest with them and a job that cannot be done."""
    folder = tmp_path_factory.mktemp("fleet")
    for number, name in enumerate(("mon", "tue"), start=1):
        tiny_drive(folder / name, number)
    # Older than what is written just now, whose digests are not kept.
    time.sleep(3.1)
    write_manifest(
        folder / "fleet.yaml",
        {"name": "mon", "config": "mon/config.yaml"},
        {"name": "gone", "config": "mon/config.yaml", "data": "nowhere"},
        {"name": "tue", "config": "tue/config.yaml"},
        defaults={"vehicle": "van 7"},
    )
    write_manifest(
        folder / "good.yaml",
        {"name": "mon", "config": "mon/config.yaml"},
        {"name": "tue", "config": "tue/config.yaml"},
    )
    return folder


@pytest.fixture(scope="module")
def finished(fleet: Path) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The batch that was never interrupted."""
    return fleet / "out", batch(fleet / "fleet.yaml", "--out", fleet / "out", "--workers", 1)


def test_one_failure_does_not_stop_the_others(
    fleet: Path, finished: tuple[Path, subprocess.CompletedProcess[str]]
) -> None:
    out, result = finished

    assert result.returncode == 3, result.stderr
    assert result.stderr == (
        f"warning: gone: {fleet / 'nowhere'}: no such folder. Set data.path (or --data) to the "
        "folder that holds input/ego_poses.yaml\n"
    )
    assert "\x1b" not in result.stdout
    assert "2 of 3 jobs have a result, 1 failed." in result.stdout
    assert "calibrating: 3/3 in " in result.stdout
    assert sorted(p.name for p in out.iterdir() if p.name[0] != ".") == [
        "index.html",
        "mon",
        "summary.csv",
        "summary.json",
        "tue",
    ]
    assert not (out / ".work").exists()
    document = json.loads((out / "summary.json").read_text())
    assert document["exit"] == 3
    jobs = {job["job"]: job for job in document["jobs"]}
    assert [(name, job["state"], job["exit"]) for name, job in jobs.items()] == [
        ("mon", "done", 0),
        ("gone", "failed", 2),
        ("tue", "done", 0),
    ]
    (van,) = document["vehicles"]
    assert (van["vehicle"], van["jobs"], van["left_out"]) == (
        "van 7",
        ["mon", "tue"],
        {"gone": "failed"},
    )
    assert van["moved"] == []
    lines = list(csv.DictReader((out / "summary.csv").open()))
    assert [(line["job"], line["lidar"]) for line in lines] == [
        ("mon", "front"),
        ("mon", "rear"),
        ("gone", ""),
        ("tue", "front"),
        ("tue", "rear"),
    ]
    page = (out / "index.html").read_text()
    assert 'href="mon/report.html"' in page
    assert (out / "mon/report.html").is_file()


def test_a_result_is_what_calibrate_writes(
    fleet: Path, finished: tuple[Path, subprocess.CompletedProcess[str]]
) -> None:
    alone = called("calibrate", fleet / "mon/config.yaml", "--out", fleet / "alone")

    assert alone.returncode == 0, alone.stderr
    names = {file.name for file in (fleet / "alone").iterdir()}
    assert {file.name for file in (finished[0] / "mon").iterdir()} == names | {"job.json"}
    for name in names - set(STAMPED):
        assert (finished[0] / "mon" / name).read_bytes() == (fleet / "alone" / name).read_bytes(), (
            name
        )


def test_drives_and_results_behind_urls(
    fleet: Path, finished: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    drive = (fleet / "mon/caliv").as_uri()
    manifest = write_manifest(
        tmp_path / "urls.yaml",
        {"name": "mon", "config": str(fleet / "mon/config.yaml"), "data": drive},
    )
    out = tmp_path / "store/fleet"
    first = called("batch", manifest, "--out", out.as_uri(), "--workers", 1)

    assert first.returncode == 0, first.stderr
    assert f"see {out.as_uri()}/index.html" in first.stdout
    # Its config names no drive: the copy that was calibrated is gone.
    names = {file.name for file in (finished[0] / "mon").iterdir()}
    assert {file.name for file in (out / "mon").iterdir()} == names
    for name in ("calibration.yaml", "target.ply"):
        assert (out / "mon" / name).read_bytes() == (finished[0] / "mon" / name).read_bytes()
    assert "path" not in yaml.safe_load((out / "mon/config.yaml").read_text())["data"]
    before = records(out)
    again = called("batch", manifest, "--out", out.as_uri())
    assert again.returncode == 0, again.stderr
    assert "1 were done or failed before" in again.stdout or "calibrating" not in again.stdout
    assert records(out) == before


def test_what_is_done_is_not_done_again_and_what_has_changed_is(
    fleet: Path, finished: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished[0], out)
    before = records(out)
    manifest = fleet / "good.yaml"

    again = called("batch", manifest, "--out", out, "--json")

    assert (again.returncode, again.stderr) == (0, "")
    document = json.loads(again.stdout)
    assert [(job["job"], job["reused"]) for job in document["jobs"]] == [
        ("mon", True),
        ("tue", True),
    ]
    assert records(out) == before
    # A job that was done by other rules is done again, and its older result stays if that fails.
    changed = write_manifest(
        fleet / "changed.yaml",
        {"name": "mon", "config": "mon/config.yaml", "limits": {"s2v_yaw_deg": 1e-3}},
        {"name": "tue", "config": "tue/config.yaml", "data": "nowhere"},
    )
    third = called("batch", changed, "--out", out, "--json", "--workers", 1)
    assert third.returncode == 3
    mon, tue = json.loads(third.stdout)["jobs"]
    assert (mon["exit"], mon["reused"]) == (3, False)
    assert "s2v_yaw_deg" in mon["unmet"][0]
    assert (tue["state"], tue["folder"]) == ("failed", None)
    assert tue["message"].endswith("(its folder still contains an older result)")
    assert records(out)["tue"] == before["tue"]
    assert records(out)["mon"] != before["mon"]


def test_interrupted_killed_and_resumed_it_ends_the_same(
    fleet: Path, finished: tuple[Path, subprocess.CompletedProcess[str]]
) -> None:
    out = fleet / "broken"
    # One of its two jobs has been done before.
    shutil.copytree(finished[0], out)
    shutil.rmtree(out / "tue")
    arguments = (fleet / "good.yaml", "--out", out, "--workers", 1)

    process = launch(*arguments)
    worker = worker_of(out, "tue")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=PATIENCE_S)

    assert (process.returncode, err) == (130, "error: interrupted\n")
    assert not alive(worker)
    assert not (out / ".work").exists()
    jobs = json.loads((out / "summary.json").read_text())["jobs"]
    assert [(job["job"], job["state"]) for job in jobs] == [("mon", "done"), ("tue", "waiting")]
    first = records(out)
    assert set(first) == {"mon"}

    process = launch(*arguments)
    worker = worker_of(out, "tue")
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=PATIENCE_S)

    assert process.returncode == -signal.SIGKILL
    wait_for(lambda: not alive(worker))
    assert (out / ".work").exists(), "it was killed at work"

    last = called("batch", *arguments)

    assert (last.returncode, last.stderr) == (0, "")
    assert not (out / ".work").exists()
    assert records(out)["mon"] == first["mon"], "it was never done again"
    assert contents(out) == contents(finished[0])


def test_a_job_that_kills_its_worker_twice_has_failed(fleet: Path) -> None:
    out = fleet / "deadly"
    process = launch(fleet / "good.yaml", "--out", out, "--workers", 1, "--json")

    for attempt in (1, 2):
        os.kill(worker_of(out, "mon", attempt), signal.SIGKILL)
    text, err = process.communicate(timeout=PATIENCE_S)

    assert process.returncode == 3
    mon, tue = json.loads(text)["jobs"]
    assert (mon["state"], mon["exit"], mon["folder"]) == ("failed", None, None)
    assert mon["message"].startswith("its worker died 2 times: process ")
    assert mon["message"].count("was killed by signal 9") == 2
    assert (tue["state"], tue["exit"]) == ("done", 0)
    assert err == f"warning: mon: {mon['message']}\n"


def certified(folder: Path) -> dict[str, str]:
    """The settings of Dask for a certificate that signs itself, as environment variables."""
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    made = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    subject = ("-days", "1", "-subj", "/CN=127.0.0.1", "-keyout", key, "-out", certificate)
    subprocess.run(["openssl", *made, *subject], check=True, capture_output=True)
    files = {"CA_FILE": certificate}
    files |= {f"{who}__{what}": path for who in ("SCHEDULER", "WORKER", "CLIENT")
              for what, path in (("CERT", certificate), ("KEY", key))}  # fmt: skip
    return {f"DASK_DISTRIBUTED__COMM__TLS__{name}": str(path) for name, path in files.items()}


@pytest.fixture
def scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A Dask scheduler and a worker, as an administrator would start them.

    With certificates, where there is openssl, which makes them.
    """
    protocol = "tls" if shutil.which("openssl") else "tcp"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"{protocol}://127.0.0.1:{free.getsockname()[1]}"
    if protocol == "tls":
        for name, value in certified(tmp_path).items():
            monkeypatch.setenv(name, value)
    dask = (sys.executable, "-m", "dask")
    local = ("--no-dashboard", "--host", "127.0.0.1", "--protocol", protocol)
    # Without the process beside the worker that would start it again.
    worker = (*dask, "worker", address, *local, "--nthreads", "1", "--no-nanny")
    commands = [
        (*dask, "scheduler", *local, "--port", address.rpartition(":")[2]),
        (*worker, "--local-directory", tmp_path),
    ]
    processes = [
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for command in commands
    ]
    yield address
    # Asked to end, they would wait for each other for half a minute.
    for process in processes:
        process.kill()
    for process in processes:
        process.wait()


def test_on_an_existing_scheduler(
    fleet: Path, finished: tuple[Path, subprocess.CompletedProcess[str]], scheduler: str
) -> None:
    out = fleet / "elsewhere"
    manifest = write_manifest(fleet / "one.yaml", {"name": "tue", "config": "tue/config.yaml"})

    result = batch(manifest, "--out", out, "--scheduler", scheduler)

    assert (result.returncode, result.stderr) == (0, "")
    here = contents(finished[0])
    assert contents(out) == {name: here[name] for name in here if name.startswith("tue/")}
    assert read_calibration(out / "tue/calibration.yaml").status == "partial"


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tcp://127.0.0.1:9", "no Dask scheduler answers there within 1 s (Connection refused)"),
        ("somewhere", "is not an address of a scheduler: expected tcp://host:port"),
    ],
)
def test_a_scheduler_that_is_not_there(
    fleet: Path, tmp_path: Path, address: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert cluster.CONNECT_S == 10.0
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)

    result = called("batch", fleet / "good.yaml", "--out", out, "--scheduler", address, "--json")

    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"error: --scheduler {address}: {said}")
    assert result.stderr.count("\n") == 1
    assert not out.exists()


def test_without_dask_it_says_how_to_get_it(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)

    result = called("batch", fleet / "good.yaml", "--out", tmp_path / "out")

    assert result.returncode == 2
    assert result.stderr == (
        "error: batch: Dask is not installed. Install it with pip install 'caliv-graph[batch]'\n"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("manifest", "said"),
    [
        ("jobs: [{name: ../x, config: c.yaml}]", "'jobs.0.name': must be letters"),
        ("jobs: [{name: a, config: c, dta: d}]", "unknown key 'jobs.0.dta': did you mean 'data'?"),
        (None, "no such file"),
    ],
)
def test_a_bad_manifest_is_one_line(tmp_path: Path, manifest: str | None, said: str) -> None:
    path = tmp_path / "fleet.yaml"
    if manifest is not None:
        path.write_text(manifest)
    before = sorted(tmp_path.iterdir())

    result = called("batch", path, "--out", tmp_path / "out")

    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"error: {path}: {said}")
    assert result.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_of_something_else_is_refused(fleet: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")

    result = called("batch", fleet / "good.yaml", "--out", tmp_path, "--force")

    assert result.returncode == 2
    assert "is not the folder of a batch (no summary.json). Give another --out" in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_help_explains_it_without_importing_anything_heavy() -> None:
    code = (
        "import sys\n"
        "from caliv_graph.cli.main import run\n"
        "run(['batch', '--help'])\n"
        "heavy = {'gtsam', 'dask', 'numpy', 'caliv_graph.config.model'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )

    assert (result.returncode, result.stderr) == (0, "")
    assert "Example: caliv-graph batch fleet.yaml --out fleet/" in result.stdout
    assert "'caliv-graph[batch]'" in " ".join(result.stdout.split()), "no markup"
