"""Which third of the structure is held out for validation: chosen by place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.strips import LEVEL, MIN_SCANS, TILE_M

ONE_OF = 3
"""One tile of so many is held out."""

SECTORS = 4
"""Headings of walls are told apart by so many sectors of half a turn: opposite faces tell the
same."""

UPRIGHT_SHARE = 0.1
"""Share of the patches of a tile from which on it counts as one of walls. Near ground is seen by
far more patches than the wall that stands on it."""


@dataclass(frozen=True)
class HeldOut:
    """The patches that are held out.

    Attributes:
        patches: (N,) whether each of the drive is.
        tiles: (h, 2) of the map that they are in, in units of `TILE_M`: x and y of the lower
            corner.
        of: number of tiles with structure.
    """

    patches: BoolArray
    tiles: IntArray
    of: int


def hold_out(patches: DrivePatches, positions_map: Array, normals_map: Array) -> HeldOut:
    """Chooses a third of the tiles of the map: everything in them is held out.

    Tiles whose walls head alike and that the same LiDARs see are taken in an order that depends on
    their place alone, and every third one is held out. So that third has its share of every
    direction and of every LiDAR, and the same drive always has the same.

    Args:
        patches: of the drive, N.
        positions_map: (N, 3) metres.
        normals_map: (N, 3) unit.
    """
    tile = np.floor(positions_map[:, :2] / TILE_M).astype(np.int64)
    tiles, number = np.unique(tile, axis=0, return_inverse=True)
    number = number.ravel()
    kinds = np.column_stack(
        [
            _headings(number, len(tiles), normals_map),
            _seen_by(patches, number, len(tiles)),
            _shuffled(tiles),
        ]
    )
    order = np.lexsort(kinds.T[::-1])
    held = np.zeros(len(tiles), dtype=bool)
    held[order[ONE_OF // 2 :: ONE_OF]] = True
    return HeldOut(held[number], tiles[held], len(tiles))


def _headings(number: IntArray, count: int, normals_map: Array) -> IntArray:
    """(T,) sector of the heading of most walls of each tile; `SECTORS` where there is ground only.

    `number` (N,) is the tile of each patch.
    """
    level = np.abs(normals_map[:, 2]) > LEVEL
    heading = np.arctan2(normals_map[:, 1], normals_map[:, 0]) % np.pi
    # Sectors are about the axes: walls along them are not split by noise.
    sector = np.round(heading / np.pi * SECTORS).astype(np.int64) % SECTORS
    sector[level] = SECTORS
    counts = np.zeros((count, SECTORS + 1))
    np.add.at(counts, (number, sector), 1.0)
    upright = counts[:, :SECTORS].sum(axis=1) > UPRIGHT_SHARE * counts.sum(axis=1)
    return np.where(upright, counts[:, :SECTORS].argmax(axis=1), SECTORS)


def _seen_by(patches: DrivePatches, number: IntArray, count: int) -> IntArray:
    """(T,) the set of LiDARs that see each tile in `MIN_SCANS` scans, a bit each."""
    pairs = np.unique(np.column_stack([number, patches.scan]), axis=0)
    scans = np.zeros((count, len(patches.lidars)), dtype=np.int64)
    np.add.at(scans, (pairs[:, 0], patches.scan_lidar[pairs[:, 1]]), 1)
    return np.asarray((scans >= MIN_SCANS) @ (1 << np.arange(len(patches.lidars))))


def _shuffled(tiles: IntArray) -> IntArray:
    """(T,) numbers that depend on x and y alone and have no pattern in the map."""
    mixed = (tiles[:, 0] * 73_856_093) ^ (tiles[:, 1] * 19_349_663)
    mixed = (mixed & 0xFFFFFFFF) * 2_654_435_761 & 0xFFFFFFFF
    return np.asarray(mixed ^ (mixed >> 15))
