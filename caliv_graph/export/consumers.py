"""Who a calibration can be exported to, and what each takes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module

from caliv_graph.errors import ExportError
from caliv_graph.export.request import Export, Request


@dataclass(frozen=True)
class Consumer:
    """One who takes calibrations.

    Attributes:
        module: of this package.
        takes: options of the command line that mean something to it.
        function: in the module.
    """

    module: str
    takes: frozenset[str]
    function: str = "export"


_FRAMES = frozenset(("--frame", "--housing", "--vehicle-frame", "--bag"))
_IMU = frozenset(("--base", "--imu"))

CONSUMERS = {
    "urdf": Consumer("urdf", _FRAMES | {"--base", "--parent"}),
    "tf": Consumer("tf", _FRAMES | {"--form"}),
    "autoware": Consumer("autoware", _FRAMES | {"--base", "--parent"}),
    "glim": Consumer("glim", _IMU),
    "lio-sam": Consumer("lio_sam", _IMU | {"--form"}),
    "fast-lio": Consumer("fast_lio", _IMU | {"--form"}),
    "mola": Consumer("mola", frozenset(("--base", "--frame", "--vehicle-frame"))),
    "npz": Consumer("covariance", frozenset(), "export_npz"),
    "json": Consumer("covariance", frozenset(), "export_json"),
    "gtsam": Consumer("gtsam_archive", frozenset(("--letter",))),
}


def check_options(consumer: str, given: Iterable[str]) -> None:
    """Refuses options that would mean nothing.

    Raises:
        ExportError: one of them is not for this consumer.
    """
    takes = CONSUMERS[consumer].takes
    for option in given:
        if option not in takes:
            others = ", ".join(name for name, c in CONSUMERS.items() if option in c.takes)
            raise ExportError(
                f"{option}: is not for --to {consumer}, but for {others}. Leave it out"
            )


def export(consumer: str, request: Request) -> Export:
    """A calibration in the form of a consumer.

    Args:
        consumer: one of `CONSUMERS`.
        request: what to export.

    Raises:
        ExportError: something is missing, or does not fit.
    """
    entry = CONSUMERS[consumer]
    module = import_module(f"caliv_graph.export.{entry.module}")
    function: Callable[[Request], Export] = getattr(module, entry.function)
    return function(request)
