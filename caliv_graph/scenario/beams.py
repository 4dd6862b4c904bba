"""The beams of a scenario's LiDAR: elevations of its channels, and directions."""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array
from caliv_graph.scenario.sensor_models import LidarModel


def channel_elevations_deg(model: LidarModel) -> Array:
    """(channels,) elevation of each channel in degrees, ascending.

    The channels are evenly spaced from the lowest to the highest elevation, both included, unless
    the model lists the elevations.
    """
    if model.elevations_deg is not None:
        return np.array(model.elevations_deg)
    return np.linspace(*model.vertical_fov_deg, model.channels)


def unit_vectors(elevation: Array, azimuth: Array) -> Array:
    """(..., 3) directions in the lidar frame from angles in radians that broadcast."""
    return np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ),
        axis=-1,
    )
