"""The consumers of a calibration, one file each.

A new consumer needs one new file here, with a function from a request to an export and
`CONSUMER = Consumer(function, ...)` (`export.request`). The name on the command line is the name of
the file, with `-` for `_`. Files are imported only when they are used.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from caliv_graph.errors import ExportError

if TYPE_CHECKING:
    from caliv_graph.export.request import Consumer, Export, Request


def consumer_names() -> tuple[str, ...]:
    """The names of all consumers, in alphabetical order."""
    return tuple(sorted(module.name.replace("_", "-") for module in iter_modules(__path__)))


def find_consumer(name: str) -> Consumer:
    """The consumer of a name, one of `consumer_names`."""
    found: Consumer = import_module(f"{__name__}.{name.replace('-', '_')}").CONSUMER
    return found


def check_options(name: str, given: Iterable[str]) -> None:
    """Refuses options of the command line that a consumer does not use.

    Raises:
        ExportError: an option is not one of this consumer.
    """
    options = find_consumer(name).options
    for option in given:
        if option not in options:
            others = [n for n in consumer_names() if option in find_consumer(n).options]
            raise ExportError(
                f"{option}: is not for --to {name}, but for {', '.join(others)}. Leave it out"
            )


def export(name: str, request: Request) -> Export:
    """A calibration in the form of a consumer.

    Raises:
        ExportError: an input of the consumer is missing or invalid.
    """
    return find_consumer(name).export(request)
