"""Errors of the channels of a LiDAR, as they move its clouds of targets.

Each channel of a LiDAR has a range, an elevation and an azimuth of its own, off by a millimetre or
more and a twentieth to a few tenths of a milliradian, the same in every scan. A target is seen by
the same few channels in scan after scan: what these have in common moves and tilts all its clouds
alike, and no average removes it (`caliv_graph/calibration/README.md`, "Channels").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.range_errors import CHANNELS_APART_RAD, RangeErrors
from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, IntArray
from caliv_graph.registration.clouds import CloudStack
from caliv_graph.registration.register import JointRegistration
from caliv_graph.structure.beams import CHANNEL_KINDS
from caliv_graph.structure.channels import found_channels, nearest_channels
from caliv_graph.targets.cloud.beams import elevations

MOST_GROUPS = 8
"""Groups of neighbouring channels of a LiDAR, at most, whose mean errors are nuisances: a LiDAR
with more has several channels to a group, and the mean of these errs less."""

SHORT_M = 0.05
"""Height of a cloud below which it does not show how an error changes along it."""

LEAST_COS = 1e-3
"""Cosine of the elevation of a cloud below which it is straight above or below its LiDAR."""

ChannelSizes = Mapping[str, tuple[float, float, float]]
"""LiDAR -> 1 sigma of the range (m), elevation and azimuth (rad) of a channel."""


def channel_sizes(
    lidars: Sequence[str], found: Sequence[ChannelSizes], usual: RangeErrors
) -> ChannelSizes:
    """Sizes that structure found in some drives, as root mean squares.

    Where in none they are those of their priors in `usual`, as where structure tells nothing.
    """
    unknown = np.array([prior.usual for prior in usual.beam_priors[:CHANNEL_KINDS]])
    out = {}
    for name in lidars:
        known = [of_drive[name] for of_drive in found if name in of_drive]
        own = np.array(known) if known else unknown[None]
        range_m, elevation_rad, azimuth_rad = np.sqrt(np.square(own).mean(axis=0)).tolist()
        out[name] = (range_m, elevation_rad, azimuth_rad)
    return out


@dataclass(frozen=True)
class OwnChannels:
    """How errors of channels seem to move the clouds of all placements, in the lidar frames.

    Attributes:
        moves: of each placement (J, 6, C): turn about the middle of a cloud (rad) and motion of it
            (m), lidar frame, by an error of 1 (m, rad) of each. The same C errors in all
            placements, kind by kind.
        lidar: (C,) the LiDAR of each, index into `lidars`.
        kind: (C,) range, elevation or azimuth.
        part: (C,) 1 sigma of each over that of one channel: a group has several.
        lidars: names.
    """

    moves: tuple[Array, ...]
    lidar: IntArray
    kind: IntArray
    part: Array
    lidars: tuple[str, ...]

    @classmethod
    def of(cls, states: Sequence[JointRegistration]) -> OwnChannels:
        """Of the clouds of all placements."""
        names = [[cloud.lidar for cloud in state.observation.clouds] for state in states]
        # In the order in which they first come: results must not depend on names.
        lidars = tuple(dict.fromkeys(name for own in names for name in own))
        index = [np.array([lidars.index(name) for name in own], dtype=np.int64) for own in names]
        of_point = [own[s.clouds.cloud] for own, s in zip(index, states, strict=True)]
        elevation = [elevations(state.clouds.beams) for state in states]
        group = [np.zeros(len(of), dtype=np.int64) for of in elevation]
        owner, parts, begin = [], [], 0
        for a in range(len(lidars)):
            some = np.concatenate([e[of == a] for e, of in zip(elevation, of_point, strict=True)])
            channels, groups = _groups(some)
            shares = []
            for state, number, e, of in zip(states, group, elevation, of_point, strict=True):
                own = nearest_channels(channels, e[of == a])
                number[of == a] = begin + groups[own]
                shares.append(_shares(state.clouds.cloud[of == a], own, len(channels)))
            part = _part_of_one(np.concatenate(shares), groups)
            parts.append(part)
            owner.append(np.full(len(part), a))
            begin += len(part)
        moves = tuple(
            _moves(state.clouds, number, begin) for state, number in zip(states, group, strict=True)
        )
        return cls(
            moves,
            np.tile(np.concatenate(owner), CHANNEL_KINDS),
            np.repeat(np.arange(CHANNEL_KINDS), begin),
            np.tile(np.concatenate(parts), CHANNEL_KINDS),
            lidars,
        )

    def directions(
        self,
        states: Sequence[JointRegistration],
        poses: Sequence[tuple[Array, Array]],
        sizes: ChannelSizes,
    ) -> Array:
        """(6 J, C) left perturbations by errors of 1 sigma of the poses of all J clouds.

        Args:
            states: the placements.
            poses: their `T_target_lidar`, (J, 3, 3) and (J, 3) of each.
            sizes: of one channel.
        """
        by_lidar = np.array([sizes[name] for name in self.lidars])
        sigma = self.part * by_lidar[self.lidar, self.kind]
        out = []
        for moves, (R, t), state in zip(self.moves, poses, states, strict=True):
            turn, shift = (np.einsum("jab,jbc->jac", R, of) for of in (moves[:, :3], moves[:, 3:]))
            middles = np.einsum("jab,jb->ja", R, state.clouds.centres) + t
            about = np.swapaxes(cross(middles[:, None], np.swapaxes(turn, 1, 2)), 1, 2)
            out.append(np.concatenate([turn, shift + about], axis=1).reshape(-1, len(sigma)))
        return np.asarray(np.concatenate(out) * sigma)


def _groups(elevation_rad: Array) -> tuple[Array, IntArray]:
    """Elevations of the channels of points (n,), ascending, and the group (k,) of each.

    Where channels cannot be told apart, bins of `CHANNELS_APART_RAD` stand for them.
    """
    channels = found_channels(elevation_rad)
    if channels is None:
        bins = np.unique(np.floor(elevation_rad / CHANNELS_APART_RAD))
        channels = (bins + 0.5) * CHANNELS_APART_RAD
    groups = min(len(channels), MOST_GROUPS)
    return channels, np.arange(len(channels)) * groups // len(channels)


def _shares(cloud: IntArray, channel: IntArray, channels: int) -> Array:
    """(j, k) share of each of k channels in the points of each of the j clouds that have some.

    `cloud` (n,), ascending, and `channel` (n,) are those of the points.
    """
    clouds, number = np.unique(cloud, return_inverse=True)
    key = number.ravel() * channels + channel
    count = np.bincount(key, minlength=len(clouds) * channels).reshape(len(clouds), channels)
    return np.asarray(count / np.maximum(count.sum(axis=1), 1)[:, None])


def _part_of_one(shares: Array, groups: IntArray) -> Array:
    """(g,) 1 sigma of the mean error of each group over that of a channel, by shares (j, k).

    Clouds that are far away see fewer channels of a group: root mean square over clouds.
    """
    into = np.eye(int(groups.max()) + 1)[groups]
    squares, whole = (shares**2 @ into).sum(axis=0), ((shares @ into) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(whole, np.finfo(float).tiny)))


def _moves(clouds: CloudStack, group: IntArray, groups: int) -> Array:
    """`OwnChannels.moves` of a placement, from the group (N,) of each point."""
    middle = clouds.centres - clouds.seen_from
    far = np.linalg.norm(middle, axis=1)
    view = middle / far[:, None]
    level = cross(np.array([0.0, 0.0, 1.0]), view)
    across = np.linalg.norm(level, axis=1)  # cosine of the elevation
    # Straight above the LiDAR no direction is level before others: that to its left is taken.
    level = np.where((across > LEAST_COS)[:, None], level, [0.0, 1.0, 0.0])
    level /= np.linalg.norm(level, axis=1)[:, None]
    up = cross(view, level)
    height = np.einsum("na,na->n", clouds.centred, up[clouds.cloud])
    key = clouds.cloud * groups + group
    shape = (clouds.count, groups)
    share = np.bincount(key, minlength=clouds.count * groups).reshape(shape) / clouds.sizes[:, None]
    sums = np.bincount(key, height, clouds.count * groups).reshape(shape)
    spread = clouds.sum_per_cloud(height**2) + clouds.sizes * SHORT_M**2
    tilt = sums / spread[:, None]
    out = np.zeros((clouds.count, 6, CHANNEL_KINDS, groups))

    def along(axes: Array, by: Array) -> Array:
        return np.asarray(axes[:, :, None] * by[:, None])

    # A range puts the points of its channel farther: a shift, and a tilt about the level axis.
    out[:, 3:, 0], out[:, :3, 0] = along(view, share), along(level, tilt)
    # An elevation turns the cloud about the LiDAR, upwards.
    out[:, 3:, 1], out[:, :3, 1] = along(up, far[:, None] * share), along(-level, share)
    # An azimuth turns it about the LiDAR's z axis; channels above one another shear it.
    sideways = (far * across)[:, None]
    upright = np.tile([0.0, 0.0, 1.0], (clouds.count, 1))
    out[:, 3:, 2] = along(level, sideways * share)
    out[:, :3, 2] = along(upright, share) - along(view, sideways * tilt)
    return out.reshape(clouds.count, 6, CHANNEL_KINDS * groups)
