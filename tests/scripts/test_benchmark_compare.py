from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.results.calibration_file import write_calibration
from scripts import benchmark_compare
from tests.fusion.drives import TRUTH, arc_information, drive, information

NAMES = ("front", "rear")


def test_what_is_drawn_errs_as_the_data_say() -> None:
    D = information(NAMES)
    pairs = benchmark_compare.drawn_pairs(drive(D, source="a"), 400, seed=1)

    errors = np.array(
        [
            np.concatenate(
                [
                    vehicle_axes_difference(calibration.lidars[n].T_vehicle_lidar, TRUTH[n])
                    for n in NAMES
                ]
            )
            for pair in pairs
            for calibration in pair
        ]
    )

    nees = np.einsum("ij,jk,ik->i", errors, D, errors)
    # 12 degrees of freedom; 800 draws leave the mean uncertain by 0.17.
    assert np.mean(nees) == pytest.approx(12.0, abs=0.7)


def test_what_is_not_determined_is_not_drawn() -> None:
    calibration = drive(arc_information(NAMES), source="a")

    assert benchmark_compare.data_root(calibration).shape == (12, 11)


def test_five_sigmas_are_those_of_the_difference() -> None:
    D = np.diag(np.tile([1e6] * 3 + [1e4] * 3, 2))
    first, second = drive(D, source="a"), drive(3.0 * D, source="b")
    move = benchmark_compare.Move("", ("rear",), 4, None)

    e, size = benchmark_compare.perturbation(first, second, move)

    assert size == pytest.approx(5.0 * np.sqrt(1e-4 + 1e-4 / 3.0), rel=1e-6)
    assert np.flatnonzero(e).tolist() == [10]


def test_the_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "calibration.yaml"
    write_calibration(drive(information(NAMES), source="a"), path)

    assert benchmark_compare.main(["--result", str(path), "--pairs", "8"]) == 0

    shown = capsys.readouterr().out
    assert "Nothing has moved: 8 pairs" in shown
    rows = [line for line in shown.splitlines() if line.startswith("  'front': 5 sigmas of ")]
    assert len(rows) == 6
    assert all(0 <= int(row.split()[-1].rstrip("%")) <= 100 for row in rows)
