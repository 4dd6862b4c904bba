"""What sections of YAML files are made of: number types, the base model, and its error messages."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from typing import Annotated, Any, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
)

_LEAST, _MOST = 1e-12, 1e12
"""Of any quantity of the config in its unit, far beyond all that is meant: squares and their
inverses stay numbers."""


_MOST_OF_A_VEHICLE_M = 100.0


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


Finite = Annotated[float, AfterValidator(_finite)]


Positive = Annotated[float, Field(gt=0.0), AfterValidator(_finite), AfterValidator(_not_tiny)]


NonNegative = Annotated[float, Field(ge=0.0), AfterValidator(_finite)]


Triple = tuple[Finite, Finite, Finite]


Place = Annotated[Triple, AfterValidator(_on_a_vehicle)]


PositiveTriple = tuple[Positive, Positive, Positive]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _nearest(key: str, known: list[str]) -> str:
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(sorted(known))}"
    return hint


def _section_at(location: tuple[int | str, ...], root: type[BaseModel]) -> type[BaseModel]:
    """The model that owns the key at `location` (its last item is the key itself)."""
    annotation: Any = root
    for item in location[:-1]:
        annotation = _inner(annotation, item)
    model = _model_in(annotation)
    return model or root


def _inner(annotation: Any, item: int | str) -> Any:
    """The annotation of what `item` selects: a field, a dictionary's value, an item of a list."""
    model = _model_in(annotation)
    if isinstance(item, int) or model is None:
        return annotation
    if get_origin(annotation) is dict:
        return get_args(annotation)[1]
    field = model.model_fields.get(item)
    return field.annotation if field else annotation


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The first model in an annotation such as `tuple[TargetRegion, ...] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        model = _model_in(inner)
        if model is not None:
            return model
    return None


def _one_line(error: ValidationError, root: type[BaseModel]) -> str:
    """The first thing wrong, as one line a person can act upon; a typo before what it hides."""
    errors = error.errors(include_url=False)
    first = min(errors, key=lambda e: e["type"] != "extra_forbidden")
    # Pydantic names the branches of a union too: they are no keys of the file. An unknown key is
    # one of the file, whatever it looks like.
    unknown = first["loc"][-1:] if first["type"] == "extra_forbidden" else ()
    location = tuple(
        item
        for item in first["loc"][: len(first["loc"]) - len(unknown)]
        if not (isinstance(item, str) and (item == "float" or "[" in item))
    )
    location += unknown
    where = ".".join(str(item) for item in location)
    # What a typo leaves missing is no second error.
    alike = [e for e in errors if e["type"] == first["type"] or first["type"] != "extra_forbidden"]
    others = len({tuple(e["loc"])[: len(location)] for e in alike}) - 1
    rest = f" (and {others} more)" if others > 0 else ""
    if first["type"] == "extra_forbidden":
        known = list(_section_at(location, root).model_fields)
        return f"unknown key '{where}': {_nearest(str(location[-1]), known)}{rest}"
    if first["type"] == "missing":
        return f"'{where}' is missing{rest}"
    message = first["msg"].removeprefix("Value error, ")
    if not location:
        return f"{message}{rest}"
    given = first["input"]
    shown = "" if isinstance(given, Mapping) else f" (got {str(given)[:60]!r})"
    return f"'{where}': {message}{shown}{rest}"
