"""Every message of exit 2 and exit 4 that the tests provoke, with its cause and its remedy.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/list_messages.py                     # the whole suite: minutes
    .venv/bin/python scripts/list_messages.py tests/cli tests/targets

Messages that differ only in numbers, names and paths are listed once. The exit code is 1 if a
message proposes to add a target although something else is the cause.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from scripts._command import exit_code_of
from scripts._runs import json_lines

PLUGIN = "scripts._messages"
VARIABLE = "MESSAGES_FILE"

REMEDY = re.compile(
    r"(?:(?<=[.;:?)] )|(?<=, )|^)(?:or |and |then |first |For [^.,;]{1,40} )?("
    r"Add|Build|Calibrate|Check|Choose|Convert|Copy|Correct|Delete|Drive|Enter|Expand|Expected|"
    r"Export|Free|Give|Install|Leave|Let|Lower|Make|Measure|Mend|Merge|Move|Name|Omit|Open|Pass|"
    r"Put|Quote|Raise|Record|Recover|Recreate|Remove|Rename|Repair|Repeat|Run|Set|Split|Start|State|"
    r"Switch|Take|Turn|Unpack|Use|Wait|Widen|Write|"
    r"add|check|choose|convert|correct|enter|give|install|leave|let|make|measure|move|name|put|"
    r"remove|rename|run|set|take|use|write|"
    r"expected|needs|must|known keys|[Dd]id you mean|Is it|allowed|Topics that fit: [^n])\b"
    r"|(?<= )must (?:be|not|lie|have|match|ascend|exceed)\b"
    r"|(?<= )\S+ (?:rpy_deg )?about .{1,40}? would fit|(?<=: )vehicle_height .{1,40}? would fit"
)
"""Where a message begins to say what to do: an imperative at the start of a clause, or what was
expected."""

ADD_TARGET = re.compile(r"add target|target: \{min", re.IGNORECASE)
"""The remedy that is right only where an object to calibrate with is missing."""

TARGET_IS_THE_CAUSE = re.compile(r"^[^:]*(?::[^:]*)?target: none found")
OTHER_CAUSES = re.compile(
    r"no ground|moving|clock|stamps are|initial guess is|lidars\.\S+\.initial is"
)


@dataclass(frozen=True)
class Message:
    """A message of the program.

    Attributes:
        exit_code: 2 or 4.
        kind: class of the error, or `contradiction`.
        cause: what it says is wrong.
        remedy: what it says to do; empty if it says nothing.
        test: a test that provokes it.
    """

    exit_code: int
    kind: str
    cause: str
    remedy: str
    test: str


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tests", nargs="*", default=["tests"], help="for pytest (default: all)")
    asked = parser.parse_args(arguments)
    messages = unique(provoked(asked.tests))
    for message in messages:
        print(f"exit {message.exit_code} {message.kind} ({message.test})")
        print(f"  cause:  {message.cause}")
        print(f"  remedy: {message.remedy or '-'}")
    without = sum(not message.remedy for message in messages)
    wrong = [message for message in messages if asks_for_a_target_wrongly(message)]
    print(
        f"{len(messages)} messages, {without} without a remedy, {len(wrong)} that propose to add "
        "a target although it is not the cause"
    )
    for message in wrong:
        print(f"wrong: {message.cause} | {message.remedy}")
    return 1 if wrong else 0


def provoked(tests: Sequence[str]) -> list[Message]:
    """Runs tests with the plugin, and reads what it noted; failing tests do not matter."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "messages.jsonl"
        subprocess.run(
            # Folders of its own: pytest would first remove those of other sessions.
            [sys.executable, "-m", "pytest", "-p", PLUGIN, f"--basetemp={folder}/tests", *tests],
            cwd=REPOSITORY,
            env={**os.environ, VARIABLE: str(path)},
            check=False,
            stdout=subprocess.DEVNULL,
        )
        lines = json_lines(path)
    return [
        Message(line["exit"], line["kind"], *parted(line["text"]), line["test"]) for line in lines
    ]


def parted(text: str) -> tuple[str, str]:
    """Cause and remedy of a message: the remedy begins at the first imperative."""
    text = " ".join(text.split())
    found = REMEDY.search(text)
    if found is None:
        return text, ""
    begin = found.start()
    return text[:begin].rstrip(" .,;:"), text[begin:]


def unique(messages: Iterable[Message]) -> list[Message]:
    """One of each: numbers, quoted names and paths do not matter."""
    seen: dict[tuple[int, str, str], Message] = {}
    for message in messages:
        text = f"{message.cause} {message.remedy}"
        shape = re.sub(r"'[^']*'|\S*/\S*|[-+]?\d[\d.e]*|\S+\.(?:yaml|bag|pcd|mcap)", "#", text)
        seen.setdefault((message.exit_code, message.kind, shape), message)
    return sorted(seen.values(), key=lambda m: (m.exit_code, m.kind, m.cause))


def asks_for_a_target_wrongly(message: Message) -> bool:
    """Whether it proposes to add a target, while a target is not what is missing."""
    if not ADD_TARGET.search(message.remedy):
        return False
    is_target = TARGET_IS_THE_CAUSE.search(message.cause) is not None
    return not is_target or OTHER_CAUSES.search(message.cause) is not None


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
