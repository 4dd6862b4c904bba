from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.readers.packet_times import continued_times

SEQUENCE_S, SHOT_S, PER_PACKET = 55.296e-6, 2.304e-6, 24
PACKET_S = PER_PACKET * SEQUENCE_S
"""Of a VLP-16, from its manual: a packet holds 24 sequences of 16 shots."""


def turn(
    packets: int = 75, turns_per_s: float = 10.0, way: float = -1.0, begin: float = 2.5
) -> tuple[Array, Array, Array]:
    """Points (N, 3), true times and times in their packet (N,) of a turn of a VLP-16."""
    p, s, k = np.meshgrid(np.arange(packets), np.arange(PER_PACKET), np.arange(16), indexing="ij")
    within = np.asarray(s * SEQUENCE_S + k * SHOT_S, np.float64).ravel()
    times = np.asarray(p.ravel() * PACKET_S + within, np.float64)
    azimuth = begin + way * 2.0 * np.pi * turns_per_s * times
    elevation = np.radians(2.0 * k.ravel() - 15.0)
    points = np.column_stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    return 8.0 * points, times, within


@pytest.mark.parametrize("way", [-1.0, 1.0])
@pytest.mark.parametrize("rate_off", [0.0, 0.004])
def test_a_turn_of_a_vlp16(way: float, rate_off: float) -> None:
    points, true_s, within = turn(way=way)

    found = continued_times(points, within, 0.1 * (1.0 + rate_off))

    assert found is not None
    assert found.times_s is not None
    assert found.packets == 75
    # A motor whose rate is off by so much from cloud to cloud.
    np.testing.assert_allclose(found.times_s, true_s, atol=0.1 * rate_off + 1e-6)


def test_beams_and_packets_without_a_return_leave_the_others_where_they_are() -> None:
    points, true_s, within = turn()
    rng = np.random.default_rng(2)
    packet = np.floor(true_s / PACKET_S + 1e-9)
    kept = (rng.random(len(true_s)) < 0.2) & ~((packet > 20) & (packet < 33))

    found = continued_times(points[kept], within[kept], 0.1)

    assert found is not None
    assert found.times_s is not None
    assert found.packets == 63
    np.testing.assert_allclose(found.times_s, true_s[kept], atol=2e-6)


def test_dual_returns_have_packets_of_half_the_time() -> None:
    points, true_s, _ = turn()
    within = np.mod(np.round(true_s, 9), PACKET_S / 2)
    points, true_s, within = (np.repeat(a, 2, axis=0) for a in (points, true_s, within))

    found = continued_times(points, within, 0.1)

    assert found is not None
    assert found.packets == 150
    assert found.times_s is not None
    np.testing.assert_allclose(found.times_s, true_s, atol=2e-6)


def test_a_rate_that_does_not_fit_the_packets_tells_nothing() -> None:
    points, _, within = turn()

    found = continued_times(points, within, 0.2)  # every other cloud is missing

    assert found is not None
    assert found.times_s is None
    assert found.problem.startswith("its times start anew 74 times in a cloud and span 1.31 ms")
    assert "a packet takes 2.65 ms" in found.problem


def test_packets_out_of_order_tell_nothing() -> None:
    points, _, within = turn()
    order = np.random.default_rng(3).permutation(75)
    points, within = (
        a.reshape(75, PER_PACKET * 16, -1)[order].reshape(len(a), -1) for a in (points, within)
    )

    found = continued_times(points, within.ravel(), 0.1)

    assert found is not None
    assert found.times_s is None


def test_other_times_are_left_alone() -> None:
    points, true_s, within = turn()
    rows = np.lexsort((true_s, points[:, 2]))  # ring by ring, as organised clouds are
    narrow = np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.4

    assert continued_times(points, true_s, 0.1) is None
    assert continued_times(points[rows], true_s[rows], 0.1) is None
    narrow_rows = rows[narrow[rows]]
    assert continued_times(points[narrow_rows], true_s[narrow_rows], 0.1) is None
    assert continued_times(points[:1], within[:1], 0.1) is None
    assert continued_times(points[:0], within[:0], 0.1) is None
