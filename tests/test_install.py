"""`pip install .` of the README, run as it stands; the packages that it would fetch are here."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_readme import README, ROOT, blocks

CARRIED = {".css", ".j2", ".js", ".md", ".typed"}
"""Of files that the program or its reader needs beside the code."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds nothing but the installed package."""
    checkout = tmp_path_factory.mktemp("checkout") / "caliv"
    left_out = shutil.ignore_patterns("__pycache__", ".*")
    shutil.copytree(ROOT / "caliv_graph", checkout / "caliv_graph", ignore=left_out)
    for name in ("pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"):
        shutil.copy(ROOT / name, checkout)
    (line,) = (x for x in "".join(blocks("sh", README)).splitlines() if x.startswith("pip "))
    target = tmp_path_factory.mktemp("site")
    own = {
        "PIP_TARGET": str(target),
        "PIP_NO_DEPS": "1",
        # pip reads this one the other way round: 0 is without isolation.
        "PIP_NO_BUILD_ISOLATION": "0",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    command = [sys.executable, "-m", *shlex.split(line)]
    done = subprocess.run(
        command, cwd=checkout, env=os.environ | own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return target


def test_the_installed_command_answers(installed: Path) -> None:
    # -I: not the checkout that these tests run in.
    code = f"import sys; sys.path.insert(0, {str(installed)!r}); import caliv_graph.cli.main as m; "
    done = subprocess.run(
        [sys.executable, "-I", "-c", code + "print(m.__file__); m.main()", "--help"],
        cwd=installed,
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(installed))
    assert "calibrate" in done.stdout
    assert (installed / "bin" / "caliv-graph").is_file()


def test_all_that_the_program_reads_is_installed(installed: Path) -> None:
    wanted = {
        path.relative_to(ROOT)
        for path in (ROOT / "caliv_graph").rglob("*")
        if path.is_file() and path.suffix in CARRIED | {".py"}
    }

    assert len(wanted) > 100
    assert {path for path in wanted if not (installed / path).is_file()} == set()


def test_the_packages_that_it_needs_are_those_that_are_tested(installed: Path) -> None:
    (info,) = installed.glob("caliv_graph-*.dist-info")
    needed = importlib.metadata.Distribution.at(info).requires or []
    names = {re.split(r"[^\w.-]", line)[0].lower() for line in needed if "extra ==" not in line}
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    locked = {name.lower() for name in re.findall(r"^([\w.-]+)(?:\[[^\]]*\])?==", lock, re.M)}

    assert {"gtsam", "numpy", "rosbags"} <= names
    assert names - locked == set()
