"""What a validation measures: per surface, per object, per pair of LiDARs, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from caliv_graph.products import Array
from caliv_graph.validation.clouds import Clouds
from caliv_graph.validation.measure import Apart, Expected, Thickness
from caliv_graph.validation.surfaces import Pole, Thing, Wall
from caliv_graph.wording.halves import Difference
from caliv_graph.wording.held_out import UNSEEN

BEFORE, AFTER, BEST = "before", "after", "best"
"""The initial guesses, the calibration, and the extrinsics with the best alignment."""

WITHOUT = "without"
"""The calibration of the drive's structure without the third that is held out."""

STAGES = (BEFORE, AFTER, BEST)

Pair = tuple[str, str]


@dataclass(frozen=True)
class SurfaceResult:
    """A wall or a pole.

    Attributes:
        name: its name, such as "wall 1".
        surface: its geometry under the best alignment, with its points.
        thickness: thickness by stage (`STAGES`).
        apart: distances by stage, per pair of LiDARs that both see it.
        expected: expected values after calibration, from known errors alone.
    """

    name: str
    surface: Wall | Pole
    points: Mapping[str, int]
    thickness: Mapping[str, Thickness]
    apart: Mapping[str, Mapping[Pair, Apart]]
    expected: Expected


@dataclass(frozen=True)
class ThingResult:
    """An object that is neither wall nor pole: a second target, a box, a bush.

    Attributes:
        name: its name, such as "object 1".
        distance_m: by stage, per pair of LiDARs, mean distance from the other's nearest point.
    """

    name: str
    thing: Thing
    points: Mapping[str, int]
    distance_m: Mapping[str, Mapping[Pair, float]]


@dataclass(frozen=True)
class PairResult:
    """Two LiDARs, over all walls and poles that both see.

    Attributes:
        lidars: the two.
        surfaces: number of these surfaces.
        distance_m: by stage, root mean square over the surfaces.
        expected_m: after calibration, from known errors alone.
        cloud_m: by stage, median distance of a point from the other's surface, mean of both ways;
            None without overlap.
        overlap: by stage, fraction of the points with a surface of the other LiDAR nearby.
    """

    lidars: Pair
    surfaces: int
    distance_m: Mapping[str, float]
    expected_m: float
    cloud_m: Mapping[str, float | None]
    overlap: Mapping[str, float]


@dataclass(frozen=True)
class HeldStrip:
    """A strip of surface that is held out.

    Attributes:
        name: its name, such as "strip 1".
        surface: number of the surface (a wall) that it is a part of, among those held out.
        centre_map: (3,) metres.
        normal_map: (3,) unit, towards the side that is seen.
        scans: LiDAR -> number of its scans that count.
        tested: whether two LiDARs see it and it is no more irregular than others.
        distance_m: by stage (`BEFORE`, `AFTER`, `WITHOUT`), per pair, signed distance of the second
            LiDAR's surface from that of the first. The first is the one with most scans.
        sigma_m: by stage except `BEFORE`, per pair, 1 sigma of it from known errors alone.
        thickness_m: by stage, root mean square distance of what single scans see from one plane;
            NaN where none of them is within the limit of incidence.
        expected_thickness_m: by stage except `BEFORE`, from known errors alone.
    """

    name: str
    surface: int
    centre_map: Array
    normal_map: Array
    scans: Mapping[str, int]
    tested: bool
    distance_m: Mapping[str, Mapping[Pair, float]]
    sigma_m: Mapping[str, Mapping[Pair, float]]
    thickness_m: Mapping[str, float]
    expected_thickness_m: Mapping[str, float]


@dataclass(frozen=True)
class HeldOutTest:
    """The chi-square of all distances on held-out strips, with their joint covariance.

    Attributes:
        chi2: with the covariance of known errors.
        dof: number of distances; 0: no two LiDARs see the same strip.
        p_value: probability of a larger one if all stated covariances are right.
        expected_m: root mean square of a distance from known errors alone.
    """

    chi2: float
    dof: int
    p_value: float | None
    expected_m: float


@dataclass(frozen=True)
class PairTest:
    """S2S of the calibration against that of the solve without the held-out strips.

    Attributes:
        lidars: the two, from and to.
        off: (6,) calibration less solve, vehicle axes at the first; rad, then m.
        sigma: (6,) 1 sigma of it, of both.
        determined: (6,) whether the structure tells the axis. Others have no meaning.
        chi2: along the directions that the structure tells.
        dof: number of these.
        p_value: probability of a larger `chi2`; None without such directions.
    """

    lidars: Pair
    off: Array
    sigma: Array
    determined: tuple[bool, ...]
    chi2: float
    dof: int
    p_value: float | None

    @property
    def worst(self) -> Difference:
        """At the determined axis that is off by most sigmas."""
        return worst_of(self.lidars, self.off, self.sigma, self.determined)


OFF_SIGMAS = 3.0
"""Sigmas from which an axis by itself is called off. Less may be off along several together."""


def worst_of(
    lidars: Sequence[str], off: Array, sigma: Array, determined: Sequence[bool]
) -> Difference:
    """A difference (6,) at the determined axis that is off by most of its sigmas (6,)."""
    sigmas = np.where(determined, np.abs(off) / sigma, 0.0)
    axis = int(sigmas.argmax())
    if sigmas[axis] < OFF_SIGMAS:
        return Difference(lidars, -1, 0.0, 0.0)
    return Difference(lidars, axis, float(off[axis]), float(sigma[axis]))


@dataclass(frozen=True)
class HeldOutStructure:
    """What the LiDARs differ by on the third of the structure that is held out.

    Attributes:
        tiles_map_m: (h, 2) lower corners, x and y in the map, of the tiles that are held out.
        tile_m: their edge.
        tiles_of: number of tiles that have structure.
        strips: the strips in them, named.
        tests: by stage, `AFTER` and `WITHOUT`.
        distance_m: by stage, root mean square over the strips that are tested.
        pairs: the extrinsics of the calibration against those of the solve without the strips.
    """

    tiles_map_m: Array
    tile_m: float
    tiles_of: int
    strips: tuple[HeldStrip, ...]
    tests: Mapping[str, HeldOutTest]
    distance_m: Mapping[str, float]
    pairs: tuple[PairTest, ...] = ()

    @property
    def tested(self) -> tuple[HeldStrip, ...]:
        """The strips of the tests."""
        return tuple(strip for strip in self.strips if strip.tested)

    def thickness_m(self, stage: str) -> float:
        """Root mean square over the strips that are tested."""
        return _rms([strip.thickness_m[stage] for strip in self.tested])

    def expected_thickness_m(self, stage: str) -> float:
        """Likewise, expected from known errors alone."""
        return _rms([strip.expected_thickness_m[stage] for strip in self.tested])


def _rms(values: Sequence[float]) -> float:
    """Of the finite ones; 0 of none."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else 0.0


Word = Literal["good", "contradicted", "worse", "unclear"]
"""The verdict in one word. `contradicted`: better than the guess, but beyond its sigmas (exit code
4); `worse`: worse than the guess beyond its sigmas (exit code 4); `unclear`: nothing was tested
(exit code 3 without structure), or noise explains the rest poorly; else `good`."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a validation.

    Attributes:
        word: the verdict in one word.
        better: ratio of the measure before calibration to after it; None: nothing measured.
        measure: `distance` between LiDARs, or `thickness` where no two see the same surface.
        of_expected: ratio of the measure after calibration to its expected value.
        chi2: chi-square of all offsets between LiDARs with their joint covariance.
        dof: its degrees of freedom; 0: no test is possible.
        p_value: probability of a larger `chi2` if all stated covariances are right.
        contradicts: whether the p-value, or one of the held-out strips, is beyond 5 sigma.
        sentences: the verdict in words.
        reason: the sentence that says why it contradicts; empty if it does not.
        only_level: whether it is `unclear` only since all that was tested is level, which tests
            neither x and y nor yaw.
    """

    word: Word
    better: float | None
    measure: str
    of_expected: float | None
    chi2: float
    dof: int
    p_value: float | None
    contradicts: bool
    sentences: tuple[str, ...]
    reason: str = ""
    only_level: bool = False

    def also(self, sentences: Sequence[str], contradicts: bool = False) -> Verdict:
        """The verdict with the sentences of another test; if that contradicts, no better word."""
        said = (*self.sentences, *sentences)
        if not contradicts:
            return replace(self, sentences=said)
        word: Word = "worse" if self.word == "worse" else "contradicted"
        reason = self.reason or sentences[0]
        return replace(self, word=word, contradicts=True, sentences=said, reason=reason)


@dataclass(frozen=True)
class Validation:
    """Result of a validation.

    Attributes:
        surfaces: walls, then poles, the largest first.
        pairs: pairs of LiDARs with a common surface or overlapping clouds.
        thickness_m: by stage, thickness of merged clouds, root mean square over the surfaces.
        alone_m: by stage, per LiDAR, likewise of its cloud alone.
        expected_thickness_m: after calibration, from known errors alone.
        expected_alone_m: likewise per LiDAR.
        best: extrinsics with the best alignment, in the order of `lidars`; no calibration.
        held_out: the third of the strips that is held out; None: not measured.
        before: what "before" is: the initial guesses, or what was found where none was given.
        unseen: what it does not see, a sentence without its full stop.
    """

    drive: str
    lidars: tuple[str, ...]
    scans: Mapping[str, int]
    surfaces: tuple[SurfaceResult, ...]
    things: tuple[ThingResult, ...]
    pairs: tuple[PairResult, ...]
    thickness_m: Mapping[str, float]
    alone_m: Mapping[str, Mapping[str, float]]
    expected_thickness_m: float
    expected_alone_m: Mapping[str, float]
    verdict: Verdict
    clouds: Clouds
    best: tuple[gtsam.Pose3, ...]
    warnings: tuple[str, ...]
    held_out: HeldOutStructure | None = None
    before: str = "the initial guesses"
    unseen: str = UNSEEN

    @property
    def has_structure(self) -> bool:
        """Whether any structure was found."""
        tested = self.held_out is not None and self.held_out.tested
        return bool(self.surfaces or self.things or tested)

    def points_map(self, stage: str) -> Array:
        """(N, 3) metres, all points under the extrinsics of a stage, map."""
        if stage == BEST:
            return self.clouds.points_map(self.clouds.placed[AFTER], self.best)
        return self.clouds.points_map(self.clouds.placed[stage])
