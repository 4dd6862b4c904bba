"""YAML from outside: safe tags only, each key once, limited depth and size.

A folder is often named 0001, 2024_05_01 or 2024-05-01. YAML 1.1 makes the numbers 1 and 20240501
and a date of them. Here they stay text: a whole number is one as YAML 1.2 and JSON write it.

A few hundred bytes of aliases can expand to gigabytes, and nested brackets overflow the stack of
the parser's C code, which ends the program. Both are checked in the parser's events: this needs no
stack and a tenth of the time of reading.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

MOST_LEVELS = 50
"""Of nested lists and keys. A calibration has seven."""

MOST_VALUES_BY_ALIAS = 200_000
"""Values that the aliases of one file may expand to, beside ten times the values written out: some
writers make an alias of poses that two sensors share."""

MOST_DIGITS = 400
"""Of a whole number. Python itself refuses to write one of more than 4300."""

_MOST_CHARACTERS = 200
"""Of a message of the parser, which quotes tags and keys whole."""


_INT, _TIMESTAMP = "tag:yaml.org,2002:int", "tag:yaml.org,2002:timestamp"

_WHOLE_NUMBER = re.compile(r"^[-+]?(0|[1-9][0-9]*)$")
"""Without the leading zeros, underscores, colons and bases of YAML 1.1."""


_CORRECT = "Correct this line or the one before: brackets, quotes, colons, spaces before keys"
"""What to do where the parser stops."""


class YamlProblemError(Exception):
    """A problem of a text, with its line where that is known, and what to do: `in line 3: ...`."""


def _refused(mark: Any, problem: str) -> YamlProblemError:
    """What this module itself refuses, at a place of the text."""
    return YamlProblemError(f"in line {mark.line + 1}: {problem}")


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A safe loader that refuses a repeated key, where others take the last one."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Builds a dictionary."""
        # A tag can call a scalar a mapping.
        if isinstance(node, yaml.MappingNode):
            seen = set()
            for key_node, _ in node.value:
                if key_node.tag == "tag:yaml.org,2002:merge":
                    continue
                if isinstance(key_node, yaml.ScalarNode):
                    if key_node.value in seen:
                        twice = f"key '{key_node.value}' is given twice. Remove one of them"
                        raise _refused(key_node.start_mark, twice)
                    seen.add(key_node.value)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_int(self, node: Any) -> Any:
        """Builds a whole number."""
        if isinstance(node, yaml.ScalarNode) and len(node.value) > MOST_DIGITS:
            digits = f"a number of {len(node.value)} digits. Write it in quotes if it is text"
            raise _refused(node.start_mark, digits)
        return super().construct_yaml_int(node)


_Loader.add_constructor(_INT, _Loader.construct_yaml_int)
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in known if tag not in (_INT, _TIMESTAMP)]
    for first, known in _Loader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_INT, _WHOLE_NUMBER, list("-+0123456789"))


def parse_yaml(text: str) -> Any:
    """Reads YAML.

    Raises:
        YamlProblemError: it is not YAML, or exceeds a limit of this module.
    """
    try:
        _check_size(text)
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as e:
        line = f"in line {e.problem_mark.line + 1}: " if e.problem_mark else ""
        problem = e.problem or e.context or "cannot be read"
        raise YamlProblemError(f"{line}{problem[:_MOST_CHARACTERS]}. {_CORRECT}") from None
    except yaml.YAMLError as e:
        said = (str(e).splitlines() or ["cannot be read"])[0]
        raise YamlProblemError(f"{said[:_MOST_CHARACTERS]}. {_CORRECT}") from None
    except (ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as e:
        # The loader trusts a tag: !!int of nothing, !!timestamp of no time.
        said = str(e)[:_MOST_CHARACTERS]
        raise YamlProblemError(f"a value does not fit its tag ({said}). Remove the tag") from None


def _check_size(text: str) -> None:
    """Raises MarkedYAMLError if nesting or aliases exceed their limit."""
    # Of each open list or mapping: its anchor, and the number of values before it.
    open_nodes: list[tuple[str | None, int]] = []
    sizes: dict[str, int] = {}
    values, aliased = 0, 0  # all of them with the aliases expanded, and those of aliases
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            values += 1
            open_nodes.append((event.anchor, values))
            if len(open_nodes) > MOST_LEVELS:
                raise _refused(
                    event.start_mark,
                    f"over {MOST_LEVELS} levels of lists or keys. Give another file",
                )
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = values - before + 1
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in open_nodes):
                raise _refused(
                    event.start_mark, f"'*{event.anchor}' contains itself. Write out its values"
                )
            size = sizes.get(event.anchor or "", 1)
            values += size
            aliased += size
            if aliased > MOST_VALUES_BY_ALIAS + 10 * (values - aliased):
                many = f"aliases expand to {aliased} values, far more than are written"
                raise _refused(event.start_mark, f"{many}. Write them out")
