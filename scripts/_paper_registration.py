"""Joint registration of GMMCalib, the first half of the paper's estimator, see `_paper`.

The points of all clouds follow a mixture of isotropic Gaussian components and one uniform outlier
class (JRMPC; Evangelidis & Horaud 2018). What the paper leaves open follows GMMCalib's published
settings: components start on the faces of a cube around the target, their first variance is the
squared diagonal of all points' bounding box, and the number of iterations is fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.errors import RegistrationError
from caliv_graph.products import Array

COMPONENTS = 400
"""Number of components in GMMCalib and CaLiV."""

ITERATIONS = 100
"""Their number of iterations; they have no other stopping rule."""

OUTLIER_RATIO = 0.1
"""Their gamma, the ratio of outliers to inliers."""

VARIANCE_ADDED_M2 = 1e-9
"""The constant they add to every variance, so that a component on a single point stays regular."""

CUBE_SIDE_M = 0.5
"""Side of the cube on which the components start."""

ABANDONED = 1e-9
"""Number of points below which a component, or a cloud, is not updated, to avoid 0 / 0."""


@dataclass(frozen=True)
class GmmRegistration:
    """Clouds registered to one mixture.

    Attributes:
        R: (J, 3, 3) rotation of each cloud into the mixture's frame.
        t: (J, 3) translation likewise, metres.
        means: (K, 3) metres: the reconstructed target.
        variances: (K,) m^2.
        priors: (K,) of the components; their sum and the outliers' prior add up to one.
        log_likelihood: of all points before each iteration; expectation-maximisation never lowers
            it.
    """

    R: Array
    t: Array
    means: Array
    variances: Array
    priors: Array
    log_likelihood: tuple[float, ...]


def cube_components(count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points in metres on the faces of a cube around the origin."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    face = np.arange(count) % 6
    points[np.arange(count), face // 2] = np.where(face % 2, 0.5, -0.5)
    return CUBE_SIDE_M * points


def register_clouds(
    clouds: Sequence[Array], means: Array, iterations: int, outlier_ratio: float = OUTLIER_RATIO
) -> GmmRegistration:
    """Registers clouds, pre-aligned except for small motions, to one mixture.

    Every iteration is an E-step, a weighted rigid fit per cloud, then means, variances and priors,
    each with the results before it.

    Args:
        clouds: (n, 3) points of each in metres, with the target near the origin.
        means: (K, 3) metres, start of the components.
        iterations: their number.
        outlier_ratio: gamma.

    Raises:
        RegistrationError: fewer than two clouds, or an empty one.
    """
    if len(clouds) < 2 or min(len(cloud) for cloud in clouds) == 0:
        raise RegistrationError(
            f"the paper's registration: {len(clouds)} clouds, "
            f"{sum(len(c) == 0 for c in clouds)} of them empty: needs two or more with points"
        )
    features = [_features(cloud) for cloud in clouds]
    everything = np.concatenate([*clouds, means])
    extent = np.ptp(everything, axis=0)
    means = means.copy()
    variances = np.full(len(means), float(extent @ extent))
    priors = np.full(len(means), 1.0 / (len(means) * (1.0 + outlier_ratio)))
    # gamma / (h (gamma + 1)), with h the volume of all points' bounding box.
    outlier_density = outlier_ratio / ((1.0 + outlier_ratio) * max(float(np.prod(extent)), 1e-9))
    R = np.tile(np.eye(3), (len(clouds), 1, 1))
    t = np.zeros((len(clouds), 3))
    history = []
    for _ in range(iterations):
        quadratic = _log_density(means, variances, priors)
        found = [
            _expect(f, _moved(quadratic, R_j, t_j), outlier_density)
            for f, R_j, t_j in zip(features, R, t, strict=True)
        ]
        history.append(sum(log_likelihood for _, log_likelihood in found))
        sums = np.array([per_component for per_component, _ in found])
        mass, first, second = sums[..., 0], sums[..., 1:4], sums[..., 4]
        R, t = _rigid_fits(mass, first, means, variances, R, t)
        means, variances, priors = _components(
            mass, first, second, R, t, means, variances, outlier_ratio
        )
    return GmmRegistration(R, t, means, variances, priors, tuple(history))


def _features(points: Array) -> Array:
    """(n, 5) features 1, v, |v|^2, in which the exponent is linear; the M-step needs their sums."""
    square = np.einsum("ni,ni->n", points, points)
    return np.column_stack([np.ones(len(points)), points, square])


def _log_density(means: Array, variances: Array, priors: Array) -> Array:
    """(5, K) coefficients: features times these are the log of p_k N(y; x_k, s2_k)."""
    scale = np.log(np.maximum(priors, 1e-300)) - 1.5 * np.log(2.0 * np.pi * variances)
    square = np.einsum("ki,ki->k", means, means)
    return np.vstack(
        [scale - 0.5 * square / variances, (means / variances[:, None]).T, -0.5 / variances]
    )


def _moved(quadratic: Array, R: Array, t: Array) -> Array:
    """The same coefficients for points v before the motion y = R v + t."""
    constant, linear, square = quadratic[0], quadratic[1:4], quadratic[4]
    return np.vstack(
        [
            constant + t @ linear + (t @ t) * square,
            R.T @ (linear + 2.0 * np.outer(t, square)),
            square,
        ]
    )


def _expect(features: Array, quadratic: Array, outlier_density: float) -> tuple[Array, float]:
    """E-step of one cloud, every component for every point.

    Returns:
        (K, 5) sums of alpha times the features, and the log-likelihood of the points.
    """
    density = features @ quadratic
    np.exp(density, out=density)
    total = density.sum(axis=1) + outlier_density
    return density.T @ (features / total[:, None]), float(np.log(total).sum())


def _rigid_fits(
    mass: Array, first: Array, means: Array, variances: Array, R: Array, t: Array
) -> tuple[Array, Array]:
    """M-step of the poses: minimises the sum of alpha / s2_k |R v + t - x_k|^2 per cloud.

    Args:
        mass: (J, K) sums of alpha.
        first: (J, K, 3) sums of alpha v.
        means: (K, 3) x_k.
        variances: (K,) s2_k.
        R: (J, 3, 3) current rotations, kept for clouds that no component explains.
        t: (J, 3) likewise.
    """
    weight = mass / variances
    total = weight.sum(axis=1)
    known = (mass.sum(axis=1) > ABANDONED) & (total > 0.0)
    safe = np.where(known, total, 1.0)[:, None]
    weighted = first / variances[:, None]
    centre_v = weighted.sum(axis=1) / safe
    centre_x = weight @ means / safe
    cross = np.einsum("ki,jkl->jil", means, weighted)
    cross -= safe[:, :, None] * centre_x[:, :, None] * centre_v[:, None, :]
    u, _, vt = np.linalg.svd(cross)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    R_new = u @ vt
    t_new = centre_x - np.einsum("jab,jb->ja", R_new, centre_v)
    return np.where(known[:, None, None], R_new, R), np.where(known[:, None], t_new, t)


def _components(
    mass: Array,
    first: Array,
    second: Array,
    R: Array,
    t: Array,
    means: Array,
    variances: Array,
    outlier_ratio: float,
) -> tuple[Array, Array, Array]:
    """M-step of means, variances and priors at the new poses; arguments as in `_rigid_fits`."""
    turned = np.einsum("jab,jkb->jka", R, first)
    moved = turned + mass[..., None] * t[:, None]
    square = second + 2.0 * np.einsum("jka,ja->jk", turned, t)
    square += mass * np.einsum("ja,ja->j", t, t)[:, None]
    total = mass.sum(axis=0)
    used = total > ABANDONED
    safe = np.where(used, total, 1.0)
    mean = moved.sum(axis=0) / safe[:, None]
    variance = (square.sum(axis=0) / safe - np.einsum("ki,ki->k", mean, mean)) / 3.0
    return (
        np.where(used[:, None], mean, means),
        np.where(used, np.maximum(variance, 0.0) + VARIANCE_ADDED_M2, variances),
        total / ((1.0 + outlier_ratio) * total.sum()),
    )
