"""Fields of a YAML file that know where they stand, so that every complaint names the place."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import gtsam
import numpy as np

from caliv_graph.errors import ConfigError
from caliv_graph.products import Array

_NORM_TOLERANCE = 1e-3
"""Of a quaternion, as in the readers: what rounding to three decimals does, and no more."""

_MOST = 1e15
"""Whole numbers up to here are exact as floats."""

_MOST_M = 1e8
"""No frame is farther from another: the earth is 12,742 km wide."""

_MOST_OF_A_MATRIX = 1e60
"""Of a covariance or an information: what is done with them stays far below what a float holds."""

_SYMMETRY_TOLERANCE = 1e-6
_EIGENVALUE_TOLERANCE = 1e-6
"""Both of a matrix scaled to ones on its diagonal: well above what writing twelve digits, or six by
somebody else, does to it."""


@dataclass(frozen=True)
class Field:
    """A value of a file that knows where it stands.

    Its methods check what it should be, and raise ConfigError with file, keys and value if it is
    something else.

    Attributes:
        value: what YAML made of it.
        file: the file.
        at: its keys, dotted; empty at the top.
    """

    value: Any
    file: str
    at: str = ""

    def fail(self, what: str) -> NoReturn:
        """Raises what is wrong here, in one line.

        Raises:
            ConfigError: always.
        """
        where = f"{self.file}: {self.at}" if self.at else self.file
        raise ConfigError(f"{where}: {what}")

    def names(self) -> dict[str, Field]:
        """The entries of a mapping."""
        if not isinstance(self.value, Mapping):
            self.fail("expected keys with values")
        return {
            str(key): Field(value, self.file, f"{self.at}.{key}" if self.at else str(key))
            for key, value in self.value.items()
        }

    def items(self) -> list[Field]:
        """The entries of a list."""
        if not isinstance(self.value, list):
            self.fail("expected a list")
        return [Field(v, self.file, f"{self.at}[{i}]") for i, v in enumerate(self.value)]

    def child(self, key: str) -> Field:
        """The entry of a mapping at a key that must be there."""
        children = self.names()
        if key not in children:
            self.fail(f"'{key}' is missing")
        return children[key]

    def get(self, key: str, default: Any) -> Field:
        """The entry of a mapping at a key that may be absent."""
        return self.names().get(key, Field(default, self.file, key))

    def one_of(self, known: Sequence[str]) -> str:
        """One of a few words."""
        if str(self.value) not in known:
            self.fail(f"{shorten(self.value)} is none of {', '.join(known)}")
        return str(self.value)

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            self.fail(f"expected true or false, got {shorten(self.value)}")
        return self.value

    def number(self) -> float:
        """A number, also infinite; and as other writers have it: 1e-05 is text to YAML 1.1."""
        if isinstance(self.value, int | float | str) and not isinstance(self.value, bool):
            try:
                return float(self.value)
            except (ValueError, OverflowError):
                pass
        self.fail(f"expected a number, got {shorten(self.value)}")

    def finite(self) -> float:
        """A number that is finite."""
        value = self.number()
        if not math.isfinite(value):
            self.fail(f"expected a finite number, got {shorten(self.value)}")
        return value

    def count(self) -> int:
        """A whole number, 0 or more."""
        value = self.number()
        if not (0.0 <= value <= _MOST and value == int(value)):
            self.fail(f"expected a whole number, 0 or more, got {shorten(self.value)}")
        return int(value)

    def vector(self, size: int) -> Array:
        """(size,) finite numbers."""
        items = self.items()
        if len(items) != size:
            self.fail(f"expected {size} numbers, got {len(items)}")
        return np.array([item.finite() for item in items])

    def symmetric(self, size: int) -> Array:
        """A covariance or information matrix, (size, size): symmetric and positive semidefinite."""
        rows = self.items()
        if len(rows) != size:
            self.fail(f"expected {size} rows of {size} numbers, got {len(rows)} rows")
        matrix = np.array([row.vector(size) for row in rows])
        if np.abs(matrix).max() > _MOST_OF_A_MATRIX:
            i, j = divmod(int(np.abs(matrix).argmax()), size)
            self.fail(f"has {matrix[i, j]:g} in row {i + 1}, column {j + 1}, which nothing can be")
        diagonal = np.diag(matrix)
        if np.any(diagonal < 0.0):
            i = int(np.argmin(diagonal))
            self.fail(f"is no covariance: {diagonal[i]:g} on the diagonal, in row {i + 1}")
        sigma = np.sqrt(diagonal)
        # A row of zeros stays one; anything else beside a zero on the diagonal shows as indefinite.
        scale = np.where(sigma > 0.0, sigma, sigma.max() or 1.0)
        scaled = matrix / np.outer(scale, scale)
        asymmetry = np.abs(scaled - scaled.T)
        if asymmetry.max() > _SYMMETRY_TOLERANCE:
            i, j = divmod(int(asymmetry.argmax()), size)
            self.fail(
                f"is not symmetric: {matrix[i, j]:g} in row {i + 1}, column {j + 1}, but "
                f"{matrix[j, i]:g} in row {j + 1}, column {i + 1}"
            )
        scaled = (scaled + scaled.T) / 2.0
        least = float(np.linalg.eigvalsh(scaled)[0])
        if least < -_EIGENVALUE_TOLERANCE:
            self.fail(
                "is not positive semidefinite: scaled to ones on its diagonal it has the "
                f"eigenvalue {least:.3g}"
            )
        return np.asarray((matrix + matrix.T) / 2.0)

    def pose(self) -> gtsam.Pose3:
        """A pose of `translation` and `quaternion_xyzw`."""
        translation = self.child("translation").vector(3)
        if np.abs(translation).max() > _MOST_M:
            self.child("translation").fail(f"is farther than {_MOST_M:g} m: {translation.tolist()}")
        node = self.child("quaternion_xyzw")
        xyzw = node.vector(4)
        norm = float(np.linalg.norm(xyzw))
        if abs(norm - 1.0) > _NORM_TOLERANCE:
            node.fail(f"has norm {norm:.6g}, expected 1 within {_NORM_TOLERANCE:g}")
        x, y, z, w = xyzw / norm
        return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), translation)


def shorten(value: Any) -> str:
    """A value as a message may show it: at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
