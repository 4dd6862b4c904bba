"""Parts of YAML files: the number types, the base model, and the sentence about a problem."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
)

_LEAST, _MOST = 1e-12, 1e12
"""Bounds of a quantity in its unit, far beyond any use: squares and their inverses stay finite."""

_MOST_OF_A_VEHICLE_M = 100.0

_SHOWN_CHARACTERS = 60
"""Of a wrong value, in a message."""

_SENTENCES = {
    "model_type": "must be keys with values",
    "dict_type": "must be keys with values",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "is not text in YAML: write it in quotes",
    "path_type": "is not text in YAML: write it in quotes",
    "too_short": "must have {min_length} or more items, has {actual_length}",
    "union_tag_invalid": "must have {discriminator} one of {expected_tags}, has '{tag}'",
    "string_pattern_mismatch": "must match the pattern {pattern}",
    "int_parsing_size": "must be a smaller whole number",
    "too_long": "must have {max_length} or fewer items, has {actual_length}",
}
"""Instead of pydantic's, which speak of Python, by the type of the error."""


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    if abs(value) > _MOST:
        raise ValueError(f"must be within +-{_MOST:g}")
    return value


def _not_tiny(value: float) -> float:
    if 0.0 < value < _LEAST:
        raise ValueError(f"must be at least {_LEAST:g}")
    return value


def _on_a_vehicle(xyz: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(map(abs, xyz)) > _MOST_OF_A_VEHICLE_M:
        raise ValueError(
            f"must be within {_MOST_OF_A_VEHICLE_M:g} m of the vehicle frame: in metres, not "
            "millimetres"
        )
    return xyz


def _within_a_metre(value: float) -> float:
    if value > 1.0:
        raise ValueError("must be at most 1 m: in metres, not millimetres")
    return value


def as_written(value: Any) -> Any:
    """A number as the text that it was: a folder may be called 2024, and a LiDAR 1."""
    # YAML reads a whole number only where its digits are all there is (`yaml_text`).
    return str(value) if type(value) is int else value


Name = Annotated[str, BeforeValidator(as_written)]
FilePath = Annotated[Path, BeforeValidator(as_written)]
Finite = Annotated[float, AfterValidator(_finite)]
Positive = Annotated[float, Field(gt=0.0), AfterValidator(_finite), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0.0), AfterValidator(_finite)]
Fine = Annotated[Positive, AfterValidator(_within_a_metre)]
"""A length of the detail that a LiDAR sees."""
Triple = tuple[Finite, Finite, Finite]
Place = Annotated[Triple, AfterValidator(_on_a_vehicle)]
PositiveTriple = tuple[Positive, Positive, Positive]


class Section(BaseModel):
    """A part of a YAML file: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def first_problem(error: ValidationError, root: type[BaseModel], remedy: str = "") -> str:
    """The first problem of a YAML file in one line: the place, what is wrong there, the value.

    An unknown key comes first: a typo also causes a missing key. `root` models the whole file.
    `remedy` is what to do about it, if it is not to correct the value.
    """
    problem, own = _first_problem(error, root)
    step = remedy or own
    return f"{problem}. {step}" if step else problem


def _first_problem(error: ValidationError, root: type[BaseModel]) -> tuple[str, str]:
    """Place and problem; what to do where the problem does not say it."""
    errors = error.errors(include_url=False)
    # That a value is not the one word or `false` of another branch of a union says nothing.
    errors = [e for e in errors if not str(e["loc"][-1:]).startswith("('literal[")] or errors
    first = min(errors, key=lambda e: e["type"] != "extra_forbidden")
    # An unknown key is a key of the file, even if it looks like the branch of a union.
    is_unknown = first["type"] == "extra_forbidden"
    unknown = first["loc"][-1:] if is_unknown else ()
    known = first["loc"][: len(first["loc"]) - len(unknown)]
    keys, section = _follow(known, root)
    keys += unknown
    where = ".".join(str(key) for key in keys)
    # A key that is missing because of a typo is no second problem.
    alike = [e for e in errors if not is_unknown or e["type"] == first["type"]]
    others = len({tuple(e["loc"])[: len(keys)] for e in alike}) - 1
    rest = f" (and {others} more)" if others > 0 else ""
    if is_unknown:
        models = _models_in(section) or [root]
        return f"unknown key '{where}': {_nearest(str(keys[-1]), models[0])}{rest}", ""
    if first["type"] == "missing":
        return f"'{where}' is missing{rest}", _to_add(known, root)
    message = first["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if first["type"] in _SENTENCES:
        message = _SENTENCES[first["type"]].format(**first.get("ctx", {}))
    if not keys:
        return f"{message}{rest}", ""
    return f"'{where}': {message}{_shown(first['input'])}{rest}", ""


def _to_add(location: Sequence[int | str], root: type[BaseModel]) -> str:
    """What a missing value is, if its model says it."""
    _, section = _follow(location[:-1], root)
    key = str(location[-1])
    fields = [m.model_fields[key] for m in _models_in(section) if key in m.model_fields]
    described = fields[0].description if fields else None
    return f"Add it: {described}" if described else "Add it"


def _shown(value: Any) -> str:
    """A wrong value for a message; a long list, or keys with values, would not help there."""
    text = str(value)
    if isinstance(value, Mapping) or (isinstance(value, list) and len(text) > _SHOWN_CHARACTERS):
        return ""
    return f" (got {text[:_SHOWN_CHARACTERS]!r})"


def _follow(location: Sequence[int | str], root: Any) -> tuple[list[int | str], Any]:
    """The keys of the file in a location of pydantic, which names the branches of unions too.

    And the annotation of the value at that place.
    """
    keys: list[int | str] = []
    annotation = root
    for item in location:
        models = _models_in(annotation)
        tagged = [model for model in models if item in _tags(model)] if len(models) > 1 else []
        if get_origin(annotation) is dict:
            # The user chooses these keys: a LiDAR may have the name of a branch.
            keys.append(item)
            annotation = get_args(annotation)[1]
        elif tagged:
            annotation = tagged[0]
        elif isinstance(item, int) or not (item == "float" or "[" in item):
            keys.append(item)
            fields = [m.model_fields[item] for m in models if item in m.model_fields]
            annotation = fields[0].annotation if fields else annotation
    return keys, annotation


def _tags(model: type[BaseModel]) -> set[Any]:
    """The tags of a model in a union: the values of fields that allow only one."""
    values = [get_args(field.annotation) for field in model.model_fields.values()]
    kinds = [get_origin(field.annotation) for field in model.model_fields.values()]
    return {v[0] for v, kind in zip(values, kinds, strict=True) if kind is Literal and len(v) == 1}


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models in an annotation such as `tuple[TargetRegion, ...] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in(inner)]


def _nearest(key: str, model: type[BaseModel]) -> str:
    known = list(model.model_fields)
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(sorted(known))}"
