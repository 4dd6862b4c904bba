"""The exit codes of the commands, and that of a calibration.

UNMET: a requirement of the config is not met. INCONSISTENT: inputs contradict each other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from caliv_graph.products import Calibration

DONE = 0
DEFECT = 1
USAGE = 2
UNMET = 3
INCONSISTENT = 4
INTERRUPTED = 130


def exit_code(calibration: Calibration) -> int:
    """The exit code of `calibrate` with this result."""
    if calibration.status == "inconsistent":
        return INCONSISTENT
    return UNMET if calibration.unmet else DONE
