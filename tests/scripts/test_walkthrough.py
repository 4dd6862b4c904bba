"""The walk-through runs as it stands, on a drive and with a config that cost little."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import yaml

from caliv_graph.simulation.simulate import write_drive
from tests.cli.commands import ROOT
from tests.workflows.test_survey import scenario_of

SCRIPT = ROOT / "scripts/walkthrough.py"


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """All that the script names in the end."""
    here = tmp_path_factory.mktemp("walk")
    folder = here / "out/walkthrough"
    write_drive(scenario_of("arc"), folder, 1, output="bag", threads=1)
    document = yaml.safe_load((folder / "config.yaml").read_text())
    document |= {
        "solve": {"mode": "staged"},
        "registration": {"components": 150, "max_points": 120},
    }
    document |= {"ground": {"use": False}}
    (folder / "my_config.yaml").write_text(yaml.safe_dump(document))
    found: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        exec(compile(SCRIPT.read_text(encoding="utf-8"), str(SCRIPT), "exec"), found)
    return found


def test_it_is_one_page_of_cells() -> None:
    lines = SCRIPT.read_text(encoding="utf-8").splitlines()

    assert len(lines) <= 60
    assert sum(line.startswith("# %% ") for line in lines) == 4


def test_registrations_odometry_and_priors_agree(names: dict[str, Any]) -> None:
    solved, scans = names["solved"], names["i"] + 1

    assert scans > 20
    # Each scan adds a pose and a registration, each but the first a step; the priors fix as many
    # extrinsics as there are. Registrations of thinned clouds are as good as the script says.
    dof = 6 * (scans - 1)
    assert 0.05 < 2.0 * names["graph"].error(solved) / dof < 1.5
    assert 0.0 < np.sqrt(np.diag(names["cov"])).max() < 0.2


def test_the_priors_hold_what_one_target_does_not_tell(names: dict[str, Any]) -> None:
    for name, lidar in names["result"].lidars.items():
        moved = lidar.T_vehicle_lidar.localCoordinates(names["solved"].atPose3(names["key"](name)))
        assert (np.abs(moved) < 3.0 * np.sqrt(np.diag(lidar.cov))).all()
