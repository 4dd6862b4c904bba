"""The constants that decide results: where they stand, why, and what benchmark_constants tries.

The mathematics that they belong to is in the README of their room.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from caliv_graph.config.model import Config
from scripts._patched import current

CONFIG = "config"
"""Instead of a module: a default of the config, `section.key`."""

Change = Callable[[Any], Any]
"""Makes of the value of a constant another one."""


def times(factor: float) -> Change:
    """Multiplies a number or array; whole numbers stay whole."""

    def change(value: Any) -> Any:
        return round(value * factor) if isinstance(value, int) else value * factor

    return change


def to(new: Any) -> Change:
    """Another value, whatever it is."""
    return lambda value: new


def at(index: int, new: float) -> Change:
    """Another value at one place of a tuple."""
    return lambda value: (*value[:index], new, *value[index + 1 :])


def levels(factor: float) -> Change:
    """Multiplies the four sigmas of a `PoseNoise`."""

    def change(value: Any) -> Any:
        names = [f.name for f in dataclasses.fields(value) if f.name != "drift_time_s"]
        return dataclasses.replace(value, **{n: factor * getattr(value, n) for n in names})

    return change


_ESTIMATING = tuple(
    f"caliv_graph.{room}." for room in ("registration", "calibration", "uncertainty")
)
"""Rooms that nothing imports which reads trajectory, target or ground."""

HALF, TWICE = times(0.5), times(2.0)

SHAPE = (("s_curve", 3), ("tri_lidar", 2))
SHORT = (("s_curve", 2), ("tri_lidar", 1))
ONE = (("s_curve", 2),)
LOST = (("staged", 3),)
GIVEN = (("given", 3),)
ALARMS = (("s_curve", 2), ("late", 2))


@dataclass(frozen=True)
class Constant:
    """A constant that decides results.

    Attributes:
        module: that defines it, or `CONFIG`.
        attribute: its name there, or `section.key`.
        unit: of its value; empty for a plain number.
        text: what it is.
        reason: where the value is from; "tried" where nothing else is said anywhere.
        drives: (drive, seeds 1 to n) that it is tried on.
        less: makes the smaller value.
        more: makes the larger value.
        part: which part of the value, if there is a row for each.
    """

    module: str
    attribute: str
    unit: str
    text: str
    reason: str
    drives: tuple[tuple[str, int], ...] = SHAPE
    less: Change = HALF
    more: Change = TWICE
    part: str = ""

    @property
    def name(self) -> str:
        """As `--only` takes it and the tables print it."""
        return f"{self.module.rpartition('.')[2]}.{self.attribute}{self.part}"

    @property
    def file(self) -> str:
        """Where it stands, under `caliv_graph/`."""
        module = "caliv_graph.config.model" if self.module == CONFIG else self.module
        return module.removeprefix("caliv_graph.").replace(".", "/") + ".py"

    @property
    def early(self) -> bool:
        """Whether it may decide trajectory, target or ground: rooms below those that estimate."""
        return not self.module.startswith(_ESTIMATING)

    def value(self) -> Any:
        """As it is.

        Raises:
            UnreachableError: there is no such constant.
        """
        if self.module != CONFIG:
            return current(self.module, self.attribute)
        section, key = self.attribute.split(".")
        default = Config.model_fields[section].default
        return getattr(default, key)


_MIXTURE = "caliv_graph.registration.mixture"
_SURFELS = "caliv_graph.registration.surfels"
_QUADRATIC = "caliv_graph.registration.quadratic"
_REGISTER = "caliv_graph.registration.register"
_CLOUDS = "caliv_graph.registration.clouds"
_VIEWS = "caliv_graph.targets.cloud.views"
_PLANES = "caliv_graph.targets.ground.planes"
_PROBLEM = "caliv_graph.calibration.problem"
_GROUND_FACTORS = "caliv_graph.calibration.ground_factors"
_ROBUST = "caliv_graph.calibration.robust"
_SNOOPING = "caliv_graph.calibration.snooping"
_NOISE = "caliv_graph.calibration.noise"
_REFINE = "caliv_graph.calibration.refine"
_OBSERVABILITY = "caliv_graph.uncertainty.observability"
_CONSISTENCY = "caliv_graph.uncertainty.consistency"

CONSTANTS: tuple[Constant, ...] = (
    # ---- the shape and the clouds
    Constant(
        _SURFELS,
        "NORMAL_CONCENTRATION",
        "",
        "concentration of a reliable normal about that of its surfel",
        "tried; 60 degrees between normals cost a factor of e^2",
    ),
    Constant(
        _SURFELS,
        "BESIDE",
        "",
        "presence of no surface in the weights of the surfels along a beam",
        "chosen: a beam that passes a surfel at 4.3 of its widths does not return from it",
    ),
    Constant(
        _QUADRATIC,
        "NORMAL_SIGMA_RAD",
        "rad",
        "prior of a surfel's normal about the mean normal of its points, 1 sigma",
        "the noise of normals near edges; the value is tried",
    ),
    Constant(
        _MIXTURE,
        "MAX_TURN_RAD",
        "rad",
        "largest turn of a surfel in one M-step",
        "a limit on the step; tried",
        SHORT,
    ),
    Constant(
        _MIXTURE,
        "REACH_SIGMAS",
        "sigma",
        "how far along the beam the intersection with a surfel may be from the point",
        "three sigma of a normal distribution",
        SHORT,
    ),
    Constant(
        _SURFELS,
        "NEIGHBOURS",
        "",
        "surfels that a beam may return from",
        "cost; farther ones have no weight",
        SHORT,
    ),
    Constant(
        _SURFELS,
        "GRAZING",
        "",
        "cosine between beam and surface at which visibility fades",
        "tried",
        ONE,
    ),
    Constant(
        _MIXTURE,
        "POINTS_PER_COMPONENT",
        "",
        "points for each surfel, at least",
        "three points fix a plane; the value is tried",
        SHORT,
    ),
    Constant(
        _MIXTURE,
        "SEED_FLATNESS",
        "",
        "reliability of a point's normal from which on a surfel may begin; not in the joint loop",
        "half of the scale of the reliability; tried",
        SHORT,
    ),
    Constant(
        CONFIG,
        "registration.components",
        "",
        "components of the target at most",
        "tried; one per 10 points where there are fewer",
        SHORT,
    ),
    Constant(
        CONFIG,
        "registration.outlier_ratio",
        "",
        "assumed ratio of outliers to inliers (gamma)",
        "the paper's gamma, its value tried",
        ONE,
    ),
    Constant(
        CONFIG,
        "registration.max_points",
        "",
        "points of one cloud at most",
        "cost",
        SHORT,
    ),
    Constant(
        _REGISTER,
        "FLOOR_PER_RANGE_SIGMA",
        "",
        "final floor of the roughness over the noise along the beam",
        "tried",
    ),
    Constant(
        _REGISTER,
        "ANNEALING",
        "",
        "factor on the floor of the roughness in each iteration",
        "tried",
        less=to(0.5),
        more=to(0.875),
    ),
    Constant(
        _REGISTER,
        "HELD_ALONG_M",
        "m",
        "sigma that holds points along the surface in the free registration, 1 sigma",
        "tried: a cloud of one flat side slides to where noise fits best",
        SHORT,
    ),
    Constant(
        _REGISTER,
        "FINE_SIGMA_M",
        "m",
        "roughness that annealing starts from once a solved graph has placed the clouds",
        "poses move by millimetres then; tried",
        ONE,
    ),
    Constant(
        _CLOUDS,
        "MERGED_RADIUS_M",
        "m",
        "neighbourhood of a normal in aligned clouds",
        "as wide as the leg of a chair",
        SHORT,
    ),
    Constant(
        _CLOUDS,
        "TRUSTED_ANGLE_RAD",
        "rad",
        "uncertainty of a normal at which it is not used any more",
        "tried",
        ONE,
    ),
    # ---- what is worth how much
    Constant(
        _VIEWS,
        "SAME_VIEW_M",
        "m",
        "distance within which scans are from one place",
        "spacing of the beams on a target at 10 m: 2 to 10 cm",
        (("s_curve", 2), ("static", 1)),
    ),
    Constant(
        _PROBLEM,
        "HEAVE_SIGMA_M",
        "m",
        "heave of the body at each stamp, 1 sigma",
        "assumed for a passenger car; the simulation draws the same 5 mm",
    ),
    Constant(
        _PLANES,
        "NORMAL_FLOOR_RAD",
        "rad",
        "sigma of a ground plane's normal in one scan, beside the noise of its points",
        "assumed for asphalt; the simulation draws the same",
    ),
    Constant(
        _PLANES,
        "DISTANCE_FLOOR_M",
        "m",
        "the same of its distance",
        "assumed for asphalt; the simulation draws the same",
    ),
    Constant(
        _GROUND_FACTORS,
        "SWAY_SIGMA_RAD",
        "rad",
        "tilt of the body at each stamp against its mean, 1 sigma (`parallel_sigma_deg` only)",
        "the released drive leans by 1.3 mrad in its turn; the simulation draws none",
        (("parallel", 2),),
    ),
    # ---- what is left out
    Constant(
        _ROBUST,
        "EXPLAINED",
        "",
        "explained part, over the median cloud's, below which a cloud has no weight",
        "tried",
        (("noisy", 2),),
        at(0, 0.2),
        at(0, 0.6),
        "[0]",
    ),
    Constant(
        _ROBUST,
        "EXPLAINED",
        "",
        "explained part from which a cloud has full weight",
        "tried",
        (("noisy", 2),),
        at(1, 0.6),
        at(1, 1.0),
        "[1]",
    ),
    Constant(
        _ROBUST,
        "FAR_OFF",
        "",
        "squared whitened residual beyond which a cloud is lost",
        "3 sigma on each of 6 axes: 54, probability 1e-9 of a chi-square of 6",
        (("staged", 3), ("noisy", 1)),
    ),
    Constant(
        CONFIG,
        "robust.huber_k",
        "",
        "whitened residual per sqrt(dof) where Huber's kernel bends",
        "Huber (1964): 1.345 is 95 percent efficient for one axis",
        (("noisy", 2),),
    ),
    Constant(
        _SNOOPING,
        "AGREEING",
        "",
        "part of the clouds by whose noise all are judged first",
        "1 - MOST_LOST: a quarter may be lost",
        LOST,
        to(0.5),
        to(0.875),
    ),
    Constant(
        _SNOOPING,
        "MOST_LOST",
        "",
        "part of a LiDAR's clouds that may be dropped for reasons of their own",
        "tried",
        LOST,
    ),
    Constant(
        _SNOOPING,
        "MIN_SNOOPED_WEIGHT",
        "",
        "weight below which a cloud is dropped where too many would be lost",
        "tried",
        LOST,
        to(0.25),
        to(0.75),
    ),
    # ---- the noise of the poses
    Constant(
        _NOISE,
        "GROSS",
        "",
        "squared residual over the median's beyond which a cloud is left out of REML",
        "tried",
        GIVEN,
    ),
    Constant(
        _NOISE,
        "TYPICAL",
        "rad, m",
        "centre of the prior on the noise of given poses (four sigmas)",
        "a filter of a good GNSS/INS; tried",
        GIVEN,
        levels(0.5),
        levels(2.0),
    ),
    Constant(
        _NOISE,
        "LOG_SPREAD",
        "",
        "sigma of that prior, natural logarithm",
        "a factor of ten; wide on purpose",
        (("given", 2),),
    ),
    Constant(
        _NOISE,
        "TYPICAL_SCALE",
        "",
        "centre of the prior on the scale of the registration's sigmas",
        "tried",
        ONE,
    ),
    Constant(
        _NOISE,
        "CLOUDS_USED",
        "",
        "clouds that REML goes by",
        "cost, which grows with the cube",
        (("given", 2),),
    ),
    # ---- the joint loop and its verdicts
    Constant(
        _REFINE,
        "DECIDED_AFTER",
        "",
        "iteration after which the number of undetermined directions is kept",
        "annealing ends before; against jumps without end",
        (("s_curve", 2), ("arc", 2)),
    ),
    Constant(
        _REFINE,
        "STEP_SIGMAS",
        "sigma",
        "step at which the joint loop has converged",
        "a tenth of a sigma is no result",
        ONE,
    ),
    Constant(
        _OBSERVABILITY,
        "UNDETERMINED_RATIO",
        "",
        "sigma of the data over that of the prior from which a direction is undetermined",
        "convention of this project: calibration/README.md",
        (("s_curve", 1), ("arc", 2)),
    ),
    Constant(
        _CONSISTENCY,
        "CONTRADICTION_SIGMAS",
        "sigma",
        "limit of the tests for contradictions",
        "probability 6e-7 of a false alarm in each of a few dozen tests",
        ALARMS,
    ),
    Constant(
        _CONSISTENCY,
        "SCALE_LIMIT",
        "",
        "scale of the registration's sigmas that is a contradiction",
        "some 25 points of a channel share its error: their sigmas are 5 times as large",
        ALARMS,
    ),
    Constant(
        _CONSISTENCY,
        "REGISTRATION_BIAS",
        "rad, m",
        "allowance in the tests for what registrations are off by from one side (1 sigma)",
        "1 mrad and 5 mm: what a registration leaves, measured",
        ALARMS,
    ),
)
