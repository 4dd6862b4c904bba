from __future__ import annotations

from pathlib import Path

from caliv_graph.results.target_file import write_target
from tests.samples import make_solution


def test_target_as_ply(tmp_path: Path) -> None:
    mixture = make_solution().registrations[0].mixture

    write_target(mixture, tmp_path / "target.ply", "chair\nof the office")

    lines = (tmp_path / "target.ply").read_text().splitlines()
    assert lines[0] == "ply"
    assert "comment chair of the office, in the target frame, metres" in lines
    assert "element vertex 2" in lines
    assert lines[lines.index("end_header") + 1 :] == [
        "0.100000 0.200000 0.300000 1.000000 0.000000 0.000000",
        "-0.100000 0.000000 0.250000 0.000000 0.000000 1.000000",
    ]
