"""Symmetries of the reconstructed target, and their elimination from a calibration.

No cloud of a drum determines the yaw of a LiDAR about its axis; if a guess is off by more than 45
degrees about a cube, registration converges 90 degrees off. The quadratic claims information on the
freedom of a drum, since its components tile a smooth surface like the dimples of a golf ball:
`marginalise_symmetry` removes it (`README.md` of this folder).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.common.cores import shared_map
from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.self_comparison import (
    Comparison,
    RotationResult,
    Shape,
    View,
    axis_and_centre,
)

ORDERS = (2, 3, 4, 5, 6, 8)
"""Orders of rotational symmetry that are tested."""

BETWEEN_DEG = (10.0, 25.0, 37.0, 53.0, 80.0, 105.0, 160.0)
"""Rotations after which no shape with few corners looks the same: a shape that passes them all has
a continuous symmetry."""

FEWEST_BETWEEN = 3
"""Minimum number of these that were seen at both ends."""

FEWEST_COMPARED = 0.3
"""Minimum part of the shape that was seen at both ends of a rotation. Half a chair is not the same
as the half that was not seen."""

MOST_CONTRADICTED = 0.12
"""Part of the compared components that may differ, beyond the part that differs without a
rotation."""

REFIT_SPACINGS = 1.0
"""Minimum gate of the fit where the axis is known to millimetres, in distances between components
(`self_comparison.MATCH_SPACINGS`)."""

UPRIGHT_COS = math.cos(math.radians(20.0))
"""Axes within 20 degrees of the vertical are upright."""


@dataclass(frozen=True)
class Symmetry:
    """A rotation after which a shape looks the same.

    Attributes:
        axis_target: (3,) unit vector along the axis.
        centre_target: (3,) metres, a place on the axis.
        angle_rad: the smallest such rotation; its multiples are others. 0: continuous symmetry.
        fitted_rad: the rotation that axis and centre were fitted at: the smallest one; of a
            continuous symmetry the one that determines them best.
        compared: part of the components that were seen at both ends of the rotation, 0 to 1.
        contradicted: part of these that differ. Of several rotations about an axis, both are of the
            one that differs most.
        unseen: indices of the components whose counterpart no beam came near. They might break the
            symmetry.
    """

    axis_target: Array
    centre_target: Array
    angle_rad: float
    fitted_rad: float
    compared: float
    contradicted: float
    unseen: IntArray

    @property
    def continuous(self) -> bool:
        """Whether any rotation about the axis is a symmetry."""
        return self.angle_rad == 0.0

    @property
    def upright(self) -> bool:
        """Whether the axis is the vertical."""
        return bool(abs(self.axis_target[2]) > UPRIGHT_COS)

    def generator(self) -> Array:
        """(6,) left perturbation (rotation then translation) of 1 rad about the axis."""
        return np.concatenate([self.axis_target, np.cross(self.centre_target, self.axis_target)])


def symmetries(
    mixture: Mixture, views: Sequence[View], sigma_range_m: float, orders: Sequence[int]
) -> tuple[Symmetry, ...]:
    """Rotations after which a reconstructed shape looks the same: the smallest of each axis.

    Tested axes: the vertical, first, and the two main horizontal directions of its surfaces. Tested
    rotations about each: `BETWEEN_DEG` for a continuous symmetry, those of `orders`, some of
    `ORDERS`, for the others. A component contradicts a rotation if beams of the `views`
    (`self_comparison.views_of`) pass through its rotated place, or end elsewhere by more than the
    noise. Places that no beam came near are listed (`Symmetry.unseen`).
    """
    if not views or len(mixture.weights) < 20:
        return ()
    shape = Shape(mixture, views, sigma_range_m)
    identity = shape.compare(np.eye(3), np.zeros(3))
    found = shared_map(lambda axis: _symmetry_about(shape, axis, identity, orders), _axes(mixture))
    return tuple(symmetry for symmetry in found if symmetry is not None)


def refit(symmetry: Symmetry, mixture: Mixture) -> Symmetry:
    """A symmetry whose axis is right to some degrees, fitted again to the shape as it now is.

    With an axis that is off by millimetres, `marginalise_symmetry` would leave information along
    the symmetry.
    """
    shape = Shape(mixture, (), 0.0)
    fits = []
    for signed in (symmetry.fitted_rad, -symmetry.fitted_rad):
        fit = shape.fit(symmetry.axis_target, signed, symmetry.centre_target, REFIT_SPACINGS)
        if fit is not None:
            fits.append(axis_and_centre(*fit, symmetry.axis_target, symmetry.centre_target))
    if not fits:
        return symmetry
    axis = np.mean([axis for axis, _ in fits], axis=0)
    return replace(
        symmetry,
        axis_target=axis / np.linalg.norm(axis),
        centre_target=np.mean([centre for _, centre in fits], axis=0),
    )


def marginalise_symmetry(H: Array, gradient: Array, symmetry: Symmetry) -> tuple[Array, Array]:
    """Marginalises the rotation of every cloud about a continuous symmetry's axis.

    Each cloud may be rotated about the axis by an angle of its own. H is the information (6 J, 6 J)
    of left perturbations of `T_target_lidar`, the gradient (6 J,). The results have the same shapes
    and are zero along every such rotation.
    """
    count = len(H) // 6
    T = np.kron(np.eye(count), symmetry.generator()[:, None])
    along = H @ T
    own = T.T @ along
    # A cloud without information stays so.
    own += np.eye(count) * max(1e-12 * float(np.trace(own)), 1e-12)
    solved = np.linalg.solve(own, np.column_stack([along.T, T.T @ gradient]))
    H = H - along @ solved[:, :-1]
    return 0.5 * (H + H.T), gradient - along @ solved[:, -1]


def alarming(symmetry: Symmetry, sigma_rad: float) -> bool:
    """Whether a symmetry can bias a calibration whose guesses have this sigma of rotation (rad)."""
    return symmetry.continuous or _confused(symmetry.angle_rad, sigma_rad)


def alarming_orders(sigma_rad: float) -> tuple[int, ...]:
    """Those of `ORDERS` that are `alarming` at this sigma (rad), and those that they imply.

    At the sigmas of usual guesses it is none of them: no time is spent on what is not reported.
    """
    confused = [order for order in ORDERS if _confused(2.0 * math.pi / order, sigma_rad)]
    return tuple(order for order in ORDERS if any(other % order == 0 for other in confused))


def _confused(angle_rad: float, sigma_rad: float) -> bool:
    """Whether a guess with this sigma may be nearer to a place that is rotated by an angle."""
    return 3.0 * sigma_rad >= 0.5 * angle_rad


def _axes(mixture: Mixture) -> list[Array]:
    """The vertical, and the two horizontal directions that most of the steep surfaces face."""
    level = mixture.normals_target[:, :2]
    angle = np.radians(np.arange(0.0, 90.0, 1.0))
    axes = np.stack([np.cos(angle), np.sin(angle)])
    # Fourth powers: sums of squares of equal faces at right angles do not depend on direction.
    crossed = np.stack([-np.sin(angle), np.cos(angle)])
    facing = np.sum((level @ axes) ** 4 + (level @ crossed) ** 4, axis=0)
    best = float(angle[int(facing.argmax())])
    c, s = math.cos(best), math.sin(best)
    return [np.array([0.0, 0.0, 1.0]), np.array([c, s, 0.0]), np.array([-s, c, 0.0])]


def _symmetry_about(
    shape: Shape, axis: Array, identity: Comparison, orders: Sequence[int]
) -> Symmetry | None:
    """The smallest rotation about an axis that is a symmetry, or None."""
    limit = identity.contradicted + MOST_CONTRADICTED
    least = FEWEST_COMPARED * identity.compared

    def worse_of_both(angle_rad: float, enough: float = math.inf) -> RotationResult | None:
        """A rotation and its inverse, the more contradicted one; None if either is hardly seen.

        If the first is contradicted by more than `enough`, the inverse is not tried.
        """
        worst: RotationResult | None = None
        for signed in (angle_rad,) if angle_rad == math.pi else (angle_rad, -angle_rad):
            result = shape.rotated(axis, signed)
            if result is None or result.comparison.compared <= least:
                return None
            if worst is None or result.comparison.contradicted > worst.comparison.contradicted:
                worst = result
            if result.comparison.contradicted > enough:
                break
        return worst

    passed: list[RotationResult] = []
    for degrees in BETWEEN_DEG:
        result = worse_of_both(math.radians(degrees))
        if result is not None and result.comparison.contradicted > limit:
            passed = []
            break
        passed += [] if result is None else [result]
    # From one side only small rotations of a drum can be seen at both ends.
    if len(passed) >= FEWEST_BETWEEN:
        worst = max(passed, key=lambda r: r.comparison.contradicted)
        # The error of a fit enters the centre by 1 / (2 sin(angle / 2)).
        wide = max(passed, key=lambda r: abs(r.angle_rad))
        return _symmetry(replace(worst, axis=wide.axis, centre=wide.centre), 0.0, wide.angle_rad)
    smallest, refuted = None, set[int]()
    for order in sorted(orders):
        # A symmetry of order 4 is one of order 2: where 180 degrees are refuted, so are 90.
        if any(order % part == 0 for part in refuted):
            continue
        result = worse_of_both(2.0 * math.pi / order, limit)
        if result is not None and result.comparison.contradicted > limit:
            refuted.add(order)
        elif result is not None:
            smallest = _symmetry(result, 2.0 * math.pi / order, result.angle_rad)
    return smallest


def _symmetry(result: RotationResult, smallest_rad: float, fitted_rad: float) -> Symmetry:
    seen = result.comparison.same | result.comparison.different
    return Symmetry(
        axis_target=result.axis,
        centre_target=result.centre,
        angle_rad=smallest_rad,
        fitted_rad=fitted_rad,
        compared=result.comparison.compared,
        contradicted=result.comparison.contradicted,
        unseen=np.flatnonzero(~seen),
    )
