"""One tree of errors. Every message says what, where, the numbers with units, and the next step.

The command line turns a `CalivError` into one line on stderr and exit code 2; anything else that
escapes is a defect of the program (exit code 1).
"""


class CalivError(Exception):
    """Base of all errors that a user can cause and correct."""


class ConfigError(CalivError):
    """The configuration, or a result file given as input, violates its schema."""


class RecordingError(CalivError):
    """A recording (folder, bag, cloud, pose file) is missing, damaged or incomplete."""


class TrajectoryError(CalivError):
    """The recorded data do not determine the vehicle's motion."""


class TargetError(CalivError):
    """The target was not found in the clouds.

    Attributes:
        what: the message without the remedy, which is wrong where another cause is known.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        self.what = what
        super().__init__(f"{what}. {remedy}" if remedy else what)


class RegistrationError(CalivError):
    """The clouds of a target could not be registered to one shape."""


class SolveError(CalivError):
    """The factor graph could not be solved."""


class ExportError(CalivError):
    """A result could not be written in the requested format."""


class OutputError(CalivError):
    """A result could not be written to the requested place."""


class BatchError(CalivError):
    """A batch cannot run: Dask is missing, or its scheduler or workers are unusable."""
