"""Types of the values in a result's file. A number may be text: see `results.model`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from caliv_graph.products import Array

_NORM_TOLERANCE = 1e-3
"""Of a quaternion, as in the readers: the effect of rounding to three decimals."""

_MOST_COUNT = 10**15
"""Whole numbers up to here are exact as floats."""

_MOST_M = 1e8
"""Of a distance between two frames: the earth is 12,742 km wide."""

_MOST_OF_A_MATRIX = 1e60
"""Of a covariance or an information: products of such numbers stay finite."""

_SYMMETRY_TOLERANCE = 1e-6
_EIGENVALUE_TOLERANCE = 1e-6
"""Both of a matrix scaled to ones on its diagonal: well above the effect of writing six digits."""


def _no_flag(raw: Any) -> Any:
    if isinstance(raw, bool):
        raise ValueError("must be a number")
    return raw


def _to_text(raw: Any) -> Any:
    """YAML takes some names and sentences for a number, a date, a flag or nothing."""
    return raw if isinstance(raw, Mapping | list | set) else str(raw)


def near(xyz: tuple[float, float, float]) -> tuple[float, float, float]:
    """A position within the limit; ValueError beyond it."""
    if max(map(abs, xyz)) > _MOST_M:
        raise ValueError(f"must be within {_MOST_M:g} m")
    return xyz


def unit(xyzw: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """A quaternion of norm 1; ValueError else."""
    norm = float(np.linalg.norm(xyzw))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise ValueError(f"must have norm 1 within {_NORM_TOLERANCE:g}, has {norm:.6g}")
    return xyzw


def check_matrix(rows: list[list[float]], size: int) -> list[list[float]]:
    """Refuses rows that are no covariance or information of this size."""
    if len(rows) != size:
        raise ValueError(f"must be {size} rows of {size} numbers, has {len(rows)} rows")
    for number, row in enumerate(rows, start=1):
        if len(row) != size:
            raise ValueError(f"must have {size} numbers in row {number}, has {len(row)}")
    matrix = np.array(rows)
    if np.abs(matrix).max() > _MOST_OF_A_MATRIX:
        i, j = divmod(int(np.abs(matrix).argmax()), size)
        raise ValueError(
            f"must be within +-{_MOST_OF_A_MATRIX:g}, has {matrix[i, j]:g} in row {i + 1}, column "
            f"{j + 1}"
        )
    diagonal = np.diag(matrix)
    if np.any(diagonal < 0.0):
        i = int(np.argmin(diagonal))
        raise ValueError(f"is no covariance: {diagonal[i]:g} on the diagonal, in row {i + 1}")
    sigma = np.sqrt(diagonal)
    # A row of zeros stays zero; other numbers beside a zero on the diagonal show as indefinite.
    scale = np.where(sigma > 0.0, sigma, sigma.max() or 1.0)
    scaled = matrix / np.outer(scale, scale)
    asymmetry = np.abs(scaled - scaled.T)
    if asymmetry.max() > _SYMMETRY_TOLERANCE:
        i, j = divmod(int(asymmetry.argmax()), size)
        raise ValueError(
            f"is not symmetric: {matrix[i, j]:g} in row {i + 1}, column {j + 1}, but "
            f"{matrix[j, i]:g} in row {j + 1}, column {i + 1}"
        )
    smallest = float(np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0])
    if smallest < -_EIGENVALUE_TOLERANCE:
        raise ValueError(
            "is not positive semidefinite: scaled to ones on its diagonal it has the eigenvalue "
            f"{smallest:.3g}"
        )
    return rows


def symmetric(rows: list[list[float]]) -> Array:
    """The matrix of `_check_matrix`, without the rounding errors of its writer."""
    matrix = np.array(rows)
    return np.asarray((matrix + matrix.T) / 2.0)


Text = Annotated[str, BeforeValidator(_to_text)]
Count = Annotated[int, Field(ge=0, le=_MOST_COUNT), BeforeValidator(_no_flag)]
Number = Annotated[float, BeforeValidator(_no_flag)]
Finite = Annotated[float, Field(allow_inf_nan=False), BeforeValidator(_no_flag)]
Sigma = Annotated[float, Field(allow_inf_nan=False, gt=0.0), BeforeValidator(_no_flag)]
Vector6 = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
Matrix = list[list[Finite]]
PoseMatrix = Annotated[Matrix, AfterValidator(partial(check_matrix, size=6))]


class Part(BaseModel):
    """A part of a result's file. Unknown keys are ignored: other programs add their own."""

    model_config = ConfigDict(frozen=True, extra="ignore")
