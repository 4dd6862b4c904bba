"""One tree of errors. Every message says what, where, the numbers with units, and the next step.

The command line turns a `CalivError` into one line on stderr and exit code 2; anything else that
escapes is a defect of the program (exit code 1).
"""

from __future__ import annotations


class CalivError(Exception):
    """Base of all errors that a user can cause and correct.

    Attributes:
        what: the message without the remedy, which is wrong where another cause is known.
        remedy: what to do about it, unless `what` says it.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        self.what = what
        self.remedy = remedy
        super().__init__(f"{what}. {remedy}" if remedy else what)

    def __reduce__(self) -> tuple[type[CalivError], tuple[str, str]]:
        """Copies between processes have the same two parts."""
        return type(self), (self.what, self.remedy)


class ConfigError(CalivError):
    """The configuration, or a result file given as input, violates its schema."""


class RecordingError(CalivError):
    """A recording (folder, bag, cloud, pose file) is missing, damaged or incomplete."""


class TrajectoryError(CalivError):
    """The recorded data do not determine the vehicle's motion."""


class TargetError(CalivError):
    """The target was not found in the clouds."""


class RegistrationError(CalivError):
    """The clouds of a target could not be registered to one shape."""


_SOLVE_REMEDY = (
    "Run 'caliv-graph inspect --config' and 'caliv-graph observability': check clocks and guesses, "
    "and what the drive shows"
)


class SolveError(CalivError):
    """The factor graph could not be solved."""

    def __init__(self, what: str, remedy: str = _SOLVE_REMEDY) -> None:
        super().__init__(what, remedy)


class ExportError(CalivError):
    """A result could not be written in the requested format."""


class OutputError(CalivError):
    """A result could not be written to the requested place."""


class BatchError(CalivError):
    """A batch cannot run: Dask is missing, or its scheduler or workers are unusable."""
