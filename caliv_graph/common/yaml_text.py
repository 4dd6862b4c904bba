"""YAML from somebody else: safe tags only, each key once, no deeper or larger than a person means.

A few hundred bytes of aliases can stand for gigabytes, and brackets in brackets overflow the stack
of the parser's C code, which ends the program. Both are looked for in the parser's events, which
needs no stack and a tenth of the time that reading takes.
"""

from __future__ import annotations

from typing import Any

import yaml

MOST_LEVELS = 50
"""Of lists and keys in each other. A calibration has seven."""

MOST_VALUES_BY_ALIAS = 200_000
"""That aliases stand for in one file, each counted as often as it is meant; and ten times what is
written out: poses that two sensors share are an alias to some writers."""

MOST_DIGITS = 400
"""Of a whole number. Python itself refuses to write one of more than 4300."""

_MOST_CHARACTERS = 200
"""Of what the parser says, which quotes tags and keys whole."""


class YamlProblemError(Exception):
    """What is wrong with a text, with its line where that is known: `in line 3: ...`."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A safe loader to which a key that stands twice is an error, not the last one's victory."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Builds a dictionary."""
        # What a tag says is a mapping need not be one.
        if isinstance(node, yaml.MappingNode):
            seen = set()
            for key_node, _ in node.value:
                if key_node.tag == "tag:yaml.org,2002:merge":
                    continue
                if isinstance(key_node, yaml.ScalarNode):
                    if key_node.value in seen:
                        raise yaml.MarkedYAMLError(
                            problem=f"key '{key_node.value}' stands twice",
                            problem_mark=key_node.start_mark,
                        )
                    seen.add(key_node.value)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_int(self, node: Any) -> Any:
        """Builds a whole number."""
        if isinstance(node, yaml.ScalarNode) and len(node.value) > MOST_DIGITS:
            raise yaml.MarkedYAMLError(
                problem=f"a number of {len(node.value)} digits", problem_mark=node.start_mark
            )
        return super().construct_yaml_int(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def parse_yaml(text: str) -> Any:
    """Reads YAML.

    Raises:
        YamlProblemError: it is not YAML, or not of a kind that is read.
    """
    try:
        _check_size(text)
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as e:
        line = f"in line {e.problem_mark.line + 1}: " if e.problem_mark else ""
        problem = e.problem or e.context or "cannot be read"
        raise YamlProblemError(f"{line}{problem[:_MOST_CHARACTERS]}") from None
    except yaml.YAMLError as e:
        said = (str(e).splitlines() or ["cannot be read"])[0]
        raise YamlProblemError(said[:_MOST_CHARACTERS]) from None
    except (ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as e:
        # The loader takes a tag at its word: !!int of nothing, !!timestamp of no time.
        said = str(e)[:_MOST_CHARACTERS]
        raise YamlProblemError(f"a value is not what it seems to be ({said})") from None


def _check_size(text: str) -> None:
    """Raises MarkedYAMLError where nesting or aliases go too far."""
    # Per open list or mapping its anchor, and the values in it.
    open_nodes: list[tuple[str | None, int]] = []
    sizes: dict[str, int] = {}
    values, aliased = 0, 0  # with what aliases stand for, and that alone
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            values += 1
            open_nodes.append((event.anchor, values))
            if len(open_nodes) > MOST_LEVELS:
                _refuse(event, f"lists or keys are nested deeper than {MOST_LEVELS} levels")
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
                _refuse(event, f"'*{event.anchor}' stands for what it is part of")
            size = sizes.get(event.anchor or "", 1)
            values += size
            aliased += size
            if aliased > MOST_VALUES_BY_ALIAS + 10 * (values - aliased):
                _refuse(event, f"aliases stand for {aliased} values, far more than are written")


def _refuse(event: Any, problem: str) -> None:
    raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
