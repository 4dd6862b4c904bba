"""Grass: LiDARs see its tips, wheels stand on the soil."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from caliv_graph.config.model import Config
from caliv_graph.pipeline.preparation import (
    HEIGHT_SHARE,
    LIFT,
    ROUGH_M,
    TILT_PER_M,
    _on_rough_ground,
)
from caliv_graph.products import Array, GroundObservation, Recording
from caliv_graph.structure.noise import roughness_m
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.read import ground_roughness_m, level
from tests.structure.test_align import TRAJECTORY, TRUTH, in_yard
from tests.structure.test_noise import patches_of

GRASS_M = 0.012


def on_grass(seeing: Collection[str]) -> DrivePatches:
    """The yard, its ground rougher as some LiDARs see it."""
    patches = in_yard()
    seen = np.isin(np.array(patches.lidars)[patches.scan_lidar[patches.scan]], list(seeing))
    rough: Array = np.where(level(patches, TRAJECTORY, TRUTH) & seen, GRASS_M, 0.0)
    return replace(patches, scatter_m=np.hypot(patches.scatter_m, rough))


def config_of(**ground: object) -> Config:
    lidars = {}
    for name, T in TRUTH.items():
        rpy = np.degrees(T.rotation().rpy()).tolist()
        guess = {"xyz": T.translation().tolist(), "rpy_deg": rpy}
        lidars[name] = {"topic": f"/{name}", "initial": guess}
    return Config.model_validate({"lidars": lidars, "ground": ground})


class Named:
    name = "meadow"


def plane_seen(lidar: str, roughness_m: float, stamp_ns: int = 0) -> GroundObservation:
    z, cov = np.array([0.0, 0.0, 1.0]), 1e-6 * np.eye(3)
    axes = np.eye(3)[:2]
    seen = GroundObservation(lidar, 0, stamp_ns, z, 1.0, axes, cov, -z, 400)
    return replace(seen, roughness_m=roughness_m)


def used(
    planes: Sequence[GroundObservation], patches: Sequence[DrivePatches], **ground: object
) -> tuple[Config, tuple[str, ...]]:
    """The config that is used, and what is said."""
    recordings = [cast("Recording", Named())]
    return _on_rough_ground(config_of(**ground), recordings, planes, patches, [TRAJECTORY])


def prepared(
    patches: DrivePatches, **ground: object
) -> tuple[float, float | None, tuple[str, ...]]:
    """Sigmas of the height and of the LiDARs' tilt (degrees) that are used, and what is said."""
    config, said = used([], [patches], **ground)
    return config.ground.sigma, config.noise.lidar_ground_tilt_deg, said


@pytest.mark.parametrize("rough_m", [0.0, 0.005, 0.02])
def test_roughness_is_told_from_noise_along_and_across_the_beams(rough_m: float) -> None:
    patches = patches_of(0.01, 1e-4)
    seen = replace(patches, scatter_m=np.hypot(patches.scatter_m, rough_m))
    every = np.ones(len(seen.scan), dtype=bool)
    assert roughness_m(seen, every) == pytest.approx([rough_m], rel=0.1, abs=5e-4)
    assert np.isnan(roughness_m(seen, np.arange(len(every)) < 100)).all()


def test_the_ground_is_as_rough_as_the_lidar_says_that_sees_the_least_of_it() -> None:
    for seeing, expected in ((TRUTH, GRASS_M), (["front"], 0.0), ([], 0.0)):
        found = ground_roughness_m(on_grass(seeing), TRAJECTORY, TRUTH)
        assert found == pytest.approx(expected, rel=0.15, abs=2e-3)
    none = in_yard().part(~level(in_yard(), TRAJECTORY, TRUTH))
    assert ground_roughness_m(none, TRAJECTORY, TRUTH) is None


def test_on_grass_the_height_is_believed_less_and_it_is_said() -> None:
    used_m, tilt_deg, (said,) = prepared(on_grass(TRUTH), vehicle_height=0.3, sigma=0.005)
    assert used_m == pytest.approx(math.hypot(0.005, LIFT * GRASS_M), rel=0.15)
    assert tilt_deg is not None
    assert tilt_deg == pytest.approx(math.degrees(TILT_PER_M * GRASS_M), rel=0.15)
    assert "meadow: the ground scatters by" in said
    assert f"to {1e3 * used_m:.0f} mm in place of ground.sigma (5 mm)" in said
    assert f"to {1e3 * math.radians(tilt_deg):.2f} mrad of tilt" in said


def test_planes_tell_it_where_grass_leaves_smooth_patches_or_none() -> None:
    """Of blades of centimetres the patches that pass for flat are the smoothest, if any pass."""
    planes = [plane_seen(name, GRASS_M, k) for name in TRUTH for k in range(8)]
    for patches in ([on_grass([])], []):
        config, (said,) = used(planes, patches, vehicle_height=0.3, sigma=0.005)
        assert config.ground.sigma == pytest.approx(math.hypot(0.005, LIFT * GRASS_M))
        assert config.noise.lidar_ground_tilt_deg == pytest.approx(
            math.degrees(TILT_PER_M * GRASS_M)
        )
        assert config.noise.lidar_ground_height_m == pytest.approx(HEIGHT_SHARE * GRASS_M)
        assert f"{1e3 * HEIGHT_SHARE * GRASS_M:.1f} mm of height" in said


def test_what_is_stated_of_rough_ground_is_used() -> None:
    planes = [plane_seen("front", GRASS_M, k) for k in range(8)]
    config = config_of()
    noise = config.noise.model_copy(
        update={"lidar_ground_tilt_deg": 0.2, "lidar_ground_height_m": 0.004}
    )
    found, _ = _on_rough_ground(
        config.model_copy(update={"noise": noise}),
        [cast("Recording", Named())],
        planes,
        [],
        [TRAJECTORY],
    )
    assert found.noise.lidar_ground_tilt_deg == 0.2
    assert found.noise.lidar_ground_height_m == 0.004


@pytest.mark.parametrize(
    "planes",
    [
        [plane_seen("front", GRASS_M, k) for k in range(7)],
        [plane_seen("front", math.nan, k) for k in range(20)],
        [plane_seen(*of, k) for k in range(8) for of in (("front", GRASS_M), ("rear", 0.003))],
    ],
    ids=["few planes", "planes that do not tell", "one LiDAR's own noise"],
)
def test_planes_that_do_not_tell_of_grass(planes: Sequence[GroundObservation]) -> None:
    config, said = used(planes, [], vehicle_height=0.3)
    assert (config.noise.lidar_ground_tilt_deg, said) == (None, ())


def test_without_a_height_grass_tilts_alone() -> None:
    used_m, tilt_deg, (said,) = prepared(on_grass(TRUTH), sigma=0.005)
    assert (used_m, tilt_deg is None) == (0.005, False)
    assert "vehicle_height" not in said
    assert "roll and pitch use drives on asphalt" in said


@pytest.mark.parametrize(
    ("seeing", "ground"),
    [
        ([], {"vehicle_height": 0.3}),
        (TRUTH, {"vehicle_height": 0.3, "use": False}),
    ],
    ids=["asphalt", "no ground"],
)
def test_else_nothing_changes(seeing: Collection[str], ground: dict[str, object]) -> None:
    assert prepared(on_grass(seeing), sigma=0.004, **ground) == (0.004, None, ())
    assert ROUGH_M < GRASS_M
