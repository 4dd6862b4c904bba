from __future__ import annotations

import json
from pathlib import Path

import pytest

from caliv_graph.errors import CalivError
from scripts import benchmark_batch
from scripts.benchmark_batch import Run


def write_job(folder: Path, written: str, pose: str = "1.0") -> None:
    """A result of a batch, as far as the comparison looks at it."""
    seconds = len(written) * 1.5
    files = {
        "calibration.yaml": f"x: {pose}\n",
        "log.jsonl": f'{{"stage": "solving", "seconds": {seconds}, "cpu_seconds": {seconds}}}\n'
        '{"result": "ok"}\n',
        "report.html": f"<p>{pose}</p><h3>Time</h3><table>{seconds}</table><p>end</p>",
    }
    folder.mkdir(parents=True)
    for name, text in files.items():
        (folder / name).write_text(text)
    sizes = {name: len(text) for name, text in files.items()}
    record = {"digest": "d", "written": written, "seconds": seconds, "files": sizes}
    (folder / "job.json").write_text(json.dumps(record))


def test_only_times_may_differ(tmp_path: Path) -> None:
    write_job(tmp_path / "whole/a", "monday")
    write_job(tmp_path / "same/a", "wednesday")
    write_job(tmp_path / "other/a", "wednesday", pose="1.1")
    write_job(tmp_path / "more/a", "monday")
    write_job(tmp_path / "more/b", "monday")
    (tmp_path / "same/.lock").write_text("process 1")

    def different(name: str) -> set[str]:
        return benchmark_batch.compare(tmp_path / "whole", tmp_path / name)

    assert different("same") == set()
    assert different("other") == {"a/calibration.yaml: differs", "a/report.html: differs"}
    assert "b/calibration.yaml: is only in one of them" in different("more")


def test_a_result_that_is_there_by_half_is_told(tmp_path: Path) -> None:
    write_job(tmp_path / "a", "monday")
    assert set(benchmark_batch.results(tmp_path)) == {"a"}

    (tmp_path / "a/calibration.yaml").write_text("")

    with pytest.raises(CalivError, match="is there, but not whole"):
        benchmark_batch.results(tmp_path)


def test_the_best_of_each_counts() -> None:
    runs = [
        Run(1, 20.0, 30.0, 0.0, 18.0),
        Run(2, 12.0, 33.0, 1.0, 20.0),
        Run(1, 24.0, 31.0, 2.0, 22.0),
    ]

    assert benchmark_batch.ratio_of(runs, "wall_s", 2) == pytest.approx(20.0 / 12.0)
    assert benchmark_batch.ratio_of(runs, "cpu_s", 2) == pytest.approx(30.0 / 33.0)


def test_a_fleet_costs_what_the_workers_take() -> None:
    """Two workers for 12 s are 24 s: 5 s for each of four drives, and 1 s that the batch adds."""
    arguments = benchmark_batch.parse_arguments(["--fleet", "600", "--price", "0.5"])
    runs = [Run(1, 22.0, 22.0, 0.0, 18.0), Run(2, 12.0, 21.0, 0.0, 20.0)]

    plan = benchmark_batch.plan_of(runs, 4, arguments)

    assert (plan.drive_s, plan.added_s) == pytest.approx((5.0, 1.0))
    assert (plan.worker_hours, plan.usd) == pytest.approx((1.0, 0.5))


@pytest.mark.parametrize("arguments", [["--drives", "0"], ["--kills", "-1"], ["--workers", "1"]])
def test_bad_arguments_are_refused(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        benchmark_batch.parse_arguments(arguments)

    assert caught.value.code == 2
    assert "must be" in capsys.readouterr().err
