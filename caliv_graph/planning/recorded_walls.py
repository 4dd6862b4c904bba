"""Walls and ground of a recorded drive, for the prediction: pieces that were seen, not planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.problem import relative_motions
from caliv_graph.structure.solve import Levels
from caliv_graph.trajectory.select import VehicleTrajectory


@dataclass(frozen=True)
class RecordedWalls:
    """The structure of a recorded drive, as it was solved. The vehicle frame is on the ground.

    Attributes:
        patches: N of them; stamps since the start of the drive.
        relative: (N, 4, 4) motion of the vehicle from the stamp of its scan to each patch's time.
        level: (N,) whether a patch is of the ground.
        stamps_ns: (m,) those of the scans, ascending.
        T_map_vehicle: m poses there, at which the pieces of one wall join.
        levels: noise of the strips that was found.
        range_sigma_m: (L,) noise along the beam of each LiDAR that was found.
    """

    patches: DrivePatches
    relative: Array
    level: BoolArray
    stamps_ns: IntArray
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    levels: Levels
    range_sigma_m: Array

    @classmethod
    def of(
        cls,
        patches: DrivePatches,
        level: BoolArray,
        trajectory: VehicleTrajectory,
        solved: tuple[IntArray, Sequence[gtsam.Pose3]],
        noise: tuple[Levels, Array],
        begin_ns: int,
        height_m: float,
    ) -> RecordedWalls:
        """From a solve in the vehicle frame of the recording.

        Args:
            patches: with the stamps of the recording.
            level: (N,) whether a patch is of the ground.
            trajectory: the vehicle's, for the motion within sweeps.
            solved: stamps (m,) and the poses of the solve there.
            noise: of strips, and (L,) along the beams.
            begin_ns: stamp that is the start of the drive.
            height_m: of the vehicle frame above ground.
        """
        down = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, -height_m]))
        stamps, poses = solved
        relative = down.inverse().matrix() @ relative_motions(patches, trajectory) @ down.matrix()
        return cls(
            replace(patches, stamps_ns=patches.stamps_ns - begin_ns),
            relative,
            level,
            stamps - begin_ns,
            tuple(T.compose(down) for T in poses),
            *noise,
        )

    def part(self, keep: BoolArray) -> RecordedWalls:
        """Some of the patches (N,)."""
        patches, relative = self.patches.part(keep), self.relative[keep]
        return replace(self, patches=patches, relative=relative, level=self.level[keep])

    def poses(self, stamps_ns: IntArray, others: Sequence[gtsam.Pose3]) -> tuple[gtsam.Pose3, ...]:
        """The poses at stamps (k,), those of `others` (k) where there was no scan."""
        known = dict(zip(self.stamps_ns.tolist(), self.T_map_vehicle, strict=True))
        return tuple(known.get(t, T) for t, T in zip(stamps_ns.tolist(), others, strict=True))
