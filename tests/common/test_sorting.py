"""Orders of whole numbers, against numpy's own."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.common.sorting import FEWEST, first_of_cells, stable_order
from caliv_graph.products import IntArray


@pytest.mark.parametrize("count", [0, 1, FEWEST - 1, FEWEST, 5000])
@pytest.mark.parametrize(("low", "high"), [(0, 1), (-7, 40), (-(2**40), 2**40), (-(2**62), 2**62)])
def test_equal_keys_stay_in_their_order(count: int, low: int, high: int) -> None:
    keys: IntArray = np.random.default_rng(count).integers(low, high, count)
    keys[: count // 2] = keys[count - count // 2 :]  # each at least twice
    assert np.array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("kind", [np.int8, np.uint16, np.int32])
def test_short_numbers_are_keys_too(kind: type) -> None:
    keys: IntArray = np.random.default_rng(1).integers(0, 100, 3000).astype(kind)
    assert np.array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("count", [0, 1, 50, 4000])
@pytest.mark.parametrize("width", [5, 2**30])  # the second leaves no room for one number
def test_the_first_of_each_cell(count: int, width: int) -> None:
    cells = np.random.default_rng(count).integers(-width, width, (count, 3))
    cells[: count // 3] = cells[count - count // 3 :]
    _, first = np.unique(cells, axis=0, return_index=True)
    assert np.array_equal(first_of_cells(cells), np.sort(first))
