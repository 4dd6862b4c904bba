"""Robust kernels: weights of clouds from their squared whitened residuals.

They stand in for the paper's percentile filter, all in one scheme: iteratively reweighted least
squares. (`CustomFactor` cannot be cloned by GTSAM's `GncOptimizer`; GTSAM has no hard trim.) A new
kernel is a class here, an entry of KERNELS, and its name in `config.model.RobustKernel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np
from scipy.special import chdtri

from caliv_graph.config.model import RobustConfig
from caliv_graph.products import Array

DOF = 6
"""Degrees of freedom of a cloud's residual."""

GNC_FACTOR = 1.4
"""Growth of the convexity parameter of graduated non-convexity (Yang et al. 2020)."""

_MOST_CONVEX = 1e3
"""Convexity parameter at which the surrogate is the truncated loss to a thousandth."""


class Kernel(ABC):
    """A rule that turns residuals into weights, round by round.

    Attributes:
        drops: whether it ever takes weight from a cloud, so that lost clouds may be dropped.
        in_joint_loop: whether clouds are weighed again in the joint loop of `refine`.
        patience: how many times as many rounds of reweighting it needs.
    """

    drops = True
    in_joint_loop = True
    patience = 1

    def __init__(self, config: RobustConfig) -> None:
        self._config = config

    @property
    def settled(self) -> bool:
        """Whether the kernel has reached its final shape."""
        return True

    @abstractmethod
    def weights(self, squared: Array) -> Array:
        """Weights (J,) from 0 to 1 of squared whitened residuals (J,) with DOF coordinates."""

    @abstractmethod
    def reason(self, weight: float) -> str:
        """Why a cloud has a weight below one, for the report."""


class NoKernel(Kernel):
    """Full weight for every cloud."""

    drops = False

    def weights(self, squared: Array) -> Array:
        """Ones."""
        return np.ones_like(squared)

    def reason(self, weight: float) -> str:
        """Never asked for."""
        return ""


class Huber(Kernel):
    """Huber's kernel: full weight up to `huber_k` per root of DOF, then falling with 1 / r."""

    def weights(self, squared: Array) -> Array:
        """`min(1, k sqrt(DOF) / r)`."""
        bend = self._config.huber_k * np.sqrt(DOF)
        return np.asarray(np.minimum(1.0, bend / np.sqrt(np.maximum(squared, 1e-12))))

    def reason(self, weight: float) -> str:
        """The residual that gives the weight."""
        bend = self._config.huber_k * np.sqrt(DOF)
        return (
            f"its pose residual is {bend / weight:.1f} sigma ({DOF} degrees of freedom; full "
            f"weight up to {bend:.1f})"
        )


class Trimmed(Kernel):
    """The worst `trim_percent` of the clouds are dropped, chosen anew in each round."""

    def weights(self, squared: Array) -> Array:
        """Zero for the worst, one for the others."""
        dropped = int(len(squared) * self._config.trim_percent / 100.0)
        weights = np.ones_like(squared)
        if dropped:
            weights[np.argsort(squared, kind="stable")[-dropped:]] = 0.0
        return weights

    def reason(self, weight: float) -> str:
        """The percentage."""
        return f"its pose residual is among the largest {self._config.trim_percent:g} percent"


class TruncatedLeastSquares(Kernel):
    """Truncated least squares by graduated non-convexity (Yang et al. 2020, eq. 14)."""

    in_joint_loop = False  # a dropped cloud has no part in the shape that would judge it
    patience = 4

    def __init__(self, config: RobustConfig) -> None:
        super().__init__(config)
        self._mu: float | None = None
        self._annealed = False

    @property
    def settled(self) -> bool:
        """Whether the surrogate has become the truncated loss."""
        return self._annealed

    def weights(self, squared: Array) -> Array:
        """Those of the surrogate loss; each call makes it less convex."""
        c2 = float(chdtri(DOF, self._config.tls_p_value))
        if self._annealed:
            return np.where(squared < c2, 1.0, 0.0)
        if self._mu is None:
            # Lost clouds are infinitely far off, and are no measure.
            worst = float(np.where(np.isfinite(squared), squared, 0.0).max())
            if 2.0 * worst <= c2:
                self._annealed = True
                return np.ones_like(squared)
            self._mu = c2 / (2.0 * worst - c2)
        mu = self._mu
        middle = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
        self._mu = mu * GNC_FACTOR
        self._annealed = self._mu > _MOST_CONVEX
        return np.clip(middle, 0.0, 1.0)

    def reason(self, weight: float) -> str:
        """The probability beyond which residuals are truncated."""
        p = self._config.tls_p_value
        return f"its pose residual is larger than noise explains (robust.tls_p_value {p:g})"


KERNELS: Mapping[str, type[Kernel]] = {
    "huber": Huber,
    "tls": TruncatedLeastSquares,
    "trimmed": Trimmed,
    "none": NoKernel,
}
"""By the name that `robust.kernel` of the config has for each."""
