"""Tilts of sightings: their noise, and what LiDARs repeat of it, against known sizes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import Array, IntArray
from caliv_graph.structure.heavy_tails import heavy_tailed, sigma_of_few, told_by_few
from caliv_graph.structure.layout import Nuisances
from caliv_graph.structure.residuals import PLANE_ROWS, Geometry
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.tilts import USUAL_RAD, fitted_tilts

STRIPS, LIDARS, SCANS = 80, 2, 12
MORE = 4
"""LiDARs of the vehicle; some see no wall."""
FEW = 4
OFFSET_M, OWN_RAD, REPEATED_RAD = 4e-4, 1.6e-3, 7e-4


BEFORE = Nuisances(
    bias=0.0,
    incidence=0.0,
    ground=0.0,
    surface=0.0,
    strip=np.zeros(STRIPS),
    sighting=np.zeros(STRIPS),
    sighting_tilt=np.full(STRIPS, 1e-3),
    strip_tilt=np.full(STRIPS, 4e-4),
    shared=0.0,
    repeated=0.0,
)


def seen(
    lidars: int, odd_rad: float = 0.0, turn_rad: float = 0.0, rougher: float = 1.0
) -> tuple[Sightings, Geometry, IntArray]:
    """Walls at x = 0, each with a tilt of its own that both LiDARs see; and the LiDARs.

    Points of 8 mm, as many as tell a tilt to 0.5 mrad. The first LiDAR sees the first wall
    `odd_rad` more turned; every scan is turned by some `turn_rad`. Of the last LiDAR, which sees a
    wall in a quarter of the scans then, tilts are `rougher` times those of the others.
    """
    rng = np.random.default_rng(11)
    strip = np.repeat(np.arange(STRIPS), lidars * SCANS)
    lidar = np.tile(np.repeat(np.arange(lidars), SCANS), STRIPS)
    of_strip = 5e-3 * rng.standard_normal((STRIPS, 2))
    of_lidar = REPEATED_RAD * rng.standard_normal((STRIPS, lidars, 2))
    of_lidar[0, 0] += odd_rad
    own = of_lidar[strip, lidar] + OWN_RAD * rng.standard_normal((len(strip), 2))
    tilt = of_strip[strip] + np.where(lidar == lidars - 1, rougher, 1.0)[:, None] * own
    scan = np.tile(np.arange(lidars * SCANS), STRIPS)
    tilt += turn_rad * rng.standard_normal((lidars * SCANS, 2))[scan]
    y, z = (g.ravel() for g in np.meshgrid(np.linspace(-0.9, 0.9, 15), np.linspace(-0.9, 0.9, 15)))
    x = (y * tilt[:, :1] + z * tilt[:, 1:]) + 4e-3 * rng.standard_normal((len(strip), len(y)))
    h = np.stack(np.broadcast_arrays(x, y, z, 1.0), axis=2)
    moments = np.einsum("qni,qnj->qij", h, h) * 4e-3**-2.0
    count = len(strip)
    plain = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    by = np.zeros((count, PLANE_ROWS.stop, 4))
    by[:, PLANE_ROWS.start, 1] = by[:, PLANE_ROWS.start + 1, 2] = 1.0
    columns = np.zeros(by.shape[:2], np.int64)
    geometry = Geometry(plain, plain, by, columns, plain[:, :3])
    points = np.full(count, float(len(y)))
    nothing = np.zeros_like(moments)
    sightings = Sightings(scan, strip, moments, nothing, np.zeros(count), points, ())
    return sightings, geometry, lidar


def fitted(
    lidars: int, odd_rad: float = 0.0, turn_rad: float = 0.0, rougher: float = 1.0
) -> tuple[Array, Array, Array]:
    sightings, geometry, lidar = seen(lidars, odd_rad, turn_rad, rougher)
    # The rough one is seen in fewer scans: the others say where a wall is.
    weights = np.where((rougher > 1.0) & (lidar == lidars - 1) & (sightings.scan % 4 > 0), 0.0, 1.0)
    return sizes_of(sightings, geometry, lidar, weights)


def sizes_of(
    sightings: Sightings, geometry: Geometry, lidar: IntArray, weights: Array
) -> tuple[Array, Array, Array]:
    offset, walls = np.full(STRIPS, OFFSET_M), np.zeros(STRIPS, np.bool_)
    return fitted_tilts(sightings, geometry, lidar, weights, walls, offset, BEFORE, MORE)


def test_a_lidar_that_sees_walls_rougher_has_larger_tilts_and_the_others_have_not() -> None:
    """So do points on a tenth of a metre, where those of others are on two."""
    own, repeated, times = fitted(3, rougher=4.0)
    # One that sees no wall in this round may see one in the next.
    assert times.shape == (MORE, 2)
    assert times[3:] == pytest.approx(1.0)
    assert times[:2, 1] == pytest.approx(1.0, abs=0.1)
    # The sizes of all have a part of it, so that the product is what counts.
    size = times[2, 1] * np.median(np.hypot(own, repeated))
    assert size == pytest.approx(4.0 * np.hypot(OWN_RAD, REPEATED_RAD), rel=0.15)


def test_lidars_that_see_walls_alike_have_tilts_alike() -> None:
    assert fitted(LIDARS)[2] == pytest.approx(1.0, abs=0.05)
    assert fitted(1)[2] == pytest.approx(1.0, abs=0.05)


def test_the_noise_of_tilts_and_what_lidars_repeat_are_told_apart() -> None:
    own, repeated, _ = fitted(LIDARS)
    assert own == pytest.approx(OWN_RAD, rel=0.05)
    assert np.sqrt(np.mean(repeated**2)) == pytest.approx(REPEATED_RAD, rel=0.15)


def test_a_wall_that_two_lidars_see_tilted_against_each_other_has_a_size_of_its_own() -> None:
    _, repeated, _ = fitted(LIDARS, odd_rad=0.01)
    assert repeated[0] > 3e-3
    assert np.median(repeated[1:]) == pytest.approx(REPEATED_RAD, rel=0.25)


def test_turns_of_whole_scans_are_no_tilts_of_walls() -> None:
    """A clock that is late turns all walls of a scan alike: it must not pass for their noise."""
    own, repeated, _ = fitted(LIDARS, turn_rad=6e-3)
    assert own == pytest.approx(OWN_RAD, rel=0.05)
    assert np.sqrt(np.mean(repeated**2)) == pytest.approx(REPEATED_RAD, rel=0.15)


def test_one_lidar_alone_does_not_tell_what_it_repeats() -> None:
    own, repeated, _ = fitted(1)
    assert own == pytest.approx(OWN_RAD, rel=0.05)
    assert repeated == pytest.approx(USUAL_RAD * math.sqrt(told_by_few(0.0)))


def test_robust_weights_count() -> None:
    sightings, geometry, lidar = seen(LIDARS)
    moments = sightings.moments.copy()
    weights = np.ones(sightings.count)
    weights[::5] = 0.0
    moments[::5, 0, 1] += 0.05 * moments[::5, 1, 1]
    moments[::5, 1, 0] = moments[::5, 0, 1]
    bent = Sightings(
        sightings.scan,
        sightings.strip,
        moments,
        sightings.noise,
        sightings.time_s,
        sightings.points,
        (),
    )
    own, *_ = sizes_of(bent, geometry, lidar, weights)
    assert own == pytest.approx(OWN_RAD, rel=0.05)


def test_scans_of_few_strips_say_less_of_what_is_repeated() -> None:
    """The turn of each scan takes a part of the tilts of its four strips with it."""
    sightings, geometry, lidar = seen(LIDARS)
    few = replace(sightings, scan=sightings.scan + 1000 * (sightings.strip // FEW))
    _, repeated, _ = sizes_of(few, geometry, lidar, np.ones(sightings.count))
    assert np.sqrt(np.mean(repeated**2)) == pytest.approx(REPEATED_RAD, rel=0.2)


def test_sizes_that_few_strips_tell_are_larger() -> None:
    """The variance of a t distribution: of `n + 2` degrees of freedom, `1 + 2 / n` times."""
    assert told_by_few(1.0) == pytest.approx(3.0, rel=0.02)
    assert told_by_few(200.0) == pytest.approx(1.01, rel=1e-4)

    assert sigma_of_few(2e-4, 0.0, 0.002) == pytest.approx(0.002 * math.sqrt(101.0))
    assert sigma_of_few(2e-4, 1.0, 0.002) == pytest.approx(0.00245, rel=0.02)
    assert sigma_of_few(2e-4, 4000.0, 0.002) == pytest.approx(2e-4, rel=0.02)

    def common(strips: int, told: float) -> float:
        """The sigma of strips whose errors are 2 mm, of which the data tell a part."""
        known = np.full(strips, told)
        sigma = np.full(strips, 0.003)
        for _ in range(50):
            sigma = heavy_tailed(known, known * 0.002**2, sigma, 0.003, (2e-4, 0.05))
        return float(sigma[0])

    assert common(1, 0.0) == pytest.approx(0.003 * math.sqrt(101.0))
    assert common(1, 0.5) > 0.004
    assert 0.002 < common(10, 0.5) < 0.0035
    assert common(400, 1.0) == pytest.approx(0.002, rel=0.02)
