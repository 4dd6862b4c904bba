"""Scenario files: the shipped ones load, wrong ones say what is wrong."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from caliv_graph.errors import ConfigError
from caliv_graph.scenario.drive_models import ArcDrive, FigureEightDrive
from caliv_graph.scenario.model import Scenario, dump_scenario, load_scenario, parse_scenario
from caliv_graph.scenario.world import make_world
from tests.cli.commands import write_config
from tests.scan_rates import scanned_at

SCENARIOS = Path(__file__).parents[2] / "configs" / "scenarios"

SHIPPED = sorted(path.stem for path in SCENARIOS.glob("*.yaml"))


def minimal() -> dict[str, Any]:
    return {
        "name": "minimal",
        "drive": {"kind": "arc", "duration_s": 17.0},
        "lidars": {"front": {"mounting": {"xyz": [2, 0, 2], "rpy_deg": [0, 10, 0]}}},
        "world": {
            "objects": {"chair": {"shape": "chair", "xy_m": [15, -9]}},
            "targets": ["chair"],
        },
    }


def all_keys(model: Any) -> set[str]:
    if isinstance(model, dict):
        return set(model).union(*(all_keys(value) for value in model.values()))
    return set()


def test_defaults_are_those_of_the_paper() -> None:
    scenario = parse_scenario(minimal(), "minimal")
    paper = load_scenario(SCENARIOS / "paper_arc.yaml")
    assert scenario.drive == paper.drive
    assert scenario.lidars["front"] == paper.lidars["front"]
    assert scenario.poses == paper.poses
    assert scenario.suspension == paper.suspension
    assert scenario.initial_guess == paper.initial_guess
    assert scenario.reference == "front"


def test_paper_arc_is_the_paper_s_set_up() -> None:
    paper = load_scenario(SCENARIOS / "paper_arc.yaml")
    assert paper.reference == "rear"
    assert paper.crop is None
    assert paper.lidars["front"].mounting.xyz == (2.0, 0.0, 2.0)
    assert paper.lidars["rear"].mounting.xyz == (-0.4, 0.0, 2.0)
    assert paper.lidars["rear"].mounting.rpy_deg == (0.0, 10.0, 180.0)
    assert isinstance(paper.drive, ArcDrive)
    # 6 m outside the arc, whose centre lies one radius to the right of the start.
    x, y = paper.world.objects["chair"].xy_m
    outside_m = (x**2 + (y + paper.drive.radius_m) ** 2) ** 0.5 - paper.drive.radius_m
    assert outside_m == pytest.approx(6.0)


def test_demo_arc_differs_in_nothing_but_size() -> None:
    paper = load_scenario(SCENARIOS / "paper_arc.yaml")
    demo = load_scenario(SCENARIOS / "demo_arc.yaml")
    full = scanned_at(demo, 10.0).model_copy(update={"name": paper.name, "crop": None})
    assert full == paper


def test_paper_arc_shows_every_key() -> None:
    path = SCENARIOS / "paper_arc.yaml"
    effective = yaml.safe_load(dump_scenario(load_scenario(path)))
    written = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert all_keys(written) == all_keys(effective)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenarios_comment_every_key(name: str) -> None:
    path = SCENARIOS / f"{name}.yaml"
    written = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert load_scenario(path).name == written["name"] == name
    commented = set()
    for line in path.read_text(encoding="utf-8").splitlines():
        key, colon, rest = line.strip().removeprefix("- ").partition(":")
        if colon and "#" in rest:
            commented.add(key)
    speak_for_themselves = {"name", "drive", "lidars", "world", "ground", "objects", "mounting"}
    speak_for_themselves |= {"imu", "gnss", "bag", "enabled", "shape", "rate_hz", "phase_s"}
    named = {*written["lidars"], *written["world"]["objects"]}
    named |= set(written["world"].get("walkers", {}))
    assert all_keys(written) - named - speak_for_themselves <= commented


def test_figure_eights_have_the_chair_6_m_outside_both_circles() -> None:
    for name in ("figure_eight", "ramp", "tri_lidar", "distorted", "noisy", "real_like"):
        scenario = load_scenario(SCENARIOS / f"{name}.yaml")
        assert isinstance(scenario.drive, FigureEightDrive)
        assert scenario.drive.radius_m == 9.16
        x, y = scenario.world.objects["chair"].xy_m
        for side in (-9.16, 9.16):
            assert (x**2 + (y - side) ** 2) ** 0.5 - 9.16 == pytest.approx(6.0, abs=0.01)


@pytest.mark.parametrize("name", SHIPPED)
def test_nothing_but_the_target_and_walkers_is_in_its_region(name: str) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    world = make_world(scenario.world)
    for target in world.targets:
        low, high = world.bounds(target)
        margin_m = scenario.world.region_margin_m
        for other in set(scenario.world.objects) - {target}:
            other_low, other_high = world.bounds(other)
            apart = (other_low > high + margin_m) | (other_high < low - margin_m)
            assert apart.any(), other


def test_dumped_scenario_loads_to_the_same(tmp_path: Path) -> None:
    for name in SHIPPED:
        scenario = load_scenario(SCENARIOS / f"{name}.yaml")
        path = tmp_path / f"{name}.yaml"
        path.write_text(dump_scenario(scenario), encoding="utf-8")
        assert load_scenario(path) == scenario


def test_scenario_is_frozen() -> None:
    scenario = parse_scenario(minimal(), "minimal")
    with pytest.raises(ValueError, match="frozen"):
        scenario.name = "other"  # type: ignore[misc]


def broken(path: str, value: Any) -> dict[str, Any]:
    raw = minimal()
    section: Any = raw
    *parents, key = path.split("/")
    for parent in parents:
        section = section[parent]
    section[key] = value
    return raw


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("drives", 1, "unknown key 'drives': did you mean 'drive'"),
        ("lidars/front/chanels", 16, "unknown key 'lidars.front.chanels': did you mean 'channels'"),
        (
            "world/objects/chair/yaw",
            3.0,
            "unknown key 'world.objects.chair.yaw': did you mean 'yaw_deg'",
        ),
        (
            "drive",
            {"kind": "straight", "duration_s": 9.0, "radius_m": 9.0},
            "key 'drive.radius_m': known keys: duration_s, kind,",
        ),
        ("drive", {"kind": "loop"}, "'loop'"),
        ("drive", {"kind": "arc"}, "'drive.duration_s' is missing. Add it: seconds"),
        ("drive/duration_s", 3.5, "at least standstill_s + 2 ramp_s, 4.0 s"),
        ("drive/speed_m_s", -2.0, "greater than 0"),
        ("lidars", {}, "lidars"),
        ("lidars/front/channels", 1, "greater than or equal to 2"),
        ("lidars/front/vertical_fov_deg", [12.5, -12.5], "12.5 degrees must be below -12.5"),
        ("lidars/front/vertical_fov_deg", [-95.0, 0.0], "within -90 and 90 degrees"),
        (
            "lidars/front/horizontal_fov_deg",
            [-180.0, 200.0],
            "spans 380.0 degrees, must not exceed 360",
        ),
        (
            "lidars/front/horizontal_resolution_deg",
            130.0,
            "must not exceed the field of view of 120",
        ),
        ("lidars/front/max_range_m", 0.5, "min_range_m (1.0 m) must be below max_range_m (0.5 m)"),
        ("lidars/front/range_sigma_m", float("nan"), "range_sigma_m"),
        ("reference", "back", "reference 'back' is not one of the lidars: set it to one of front"),
        ("world/targets", ["table"], "target 'table' is not one of the objects: name one of chair"),
        ("world/objects/chair/shape", "sofa", "'sofa'"),
        ("name", "two\nlines", "name"),
        ("lidars/front/elevations_deg", [-3.0, -3.0, 1.0], "elevations_deg must ascend"),
        ("lidars/front/elevations_deg", [-95.0, 1.0], "elevations_deg must lie within -90 and 90"),
        ("lidars/front/sweep", {"duration_s": 0.2}, "must not exceed the 0.1 s between two clouds"),
        (
            "lidars/front/sweep",
            {"stamp_at": "end"},
            "time_field 't' is unsigned and cannot count back from the end",
        ),
        ("lidars/front/sweep", {"time_field": "stamp"}, "time_field"),
        ("lidars/front/edges", {"lost_probability": 1.2}, "less than or equal to 1"),
        ("world/objects/ground", {"shape": "box", "xy_m": [9, 9], "size_m": [1, 1, 1]}, "ground"),
        (
            "world/walkers",
            {"chair": {"from_xy_m": [1, 1], "to_xy_m": [4, 4]}},
            "'chair' is the name of an object and of a walker",
        ),
        (
            "world/walkers",
            {"who": {"from_xy_m": [1, 1], "to_xy_m": [1, 1]}},
            "0.00 m apart, must be 0.1 m or more",
        ),
        ("imu", {"rate_hz": 0.0}, "greater than 0"),
        ("imu", {"acc_sigma": 0.1}, "unknown key 'imu.acc_sigma'"),
        ("gnss", {"jumps": [{"start_s": 1.0}]}, "missing"),
        ("bag", {"compression": "lz4"}, "compression"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(path: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_scenario(broken(path, value), "scenario.yaml")
    text = str(caught.value)
    assert text.startswith("scenario.yaml: ")
    assert message in text
    assert "\n" not in text


@pytest.mark.parametrize("raw", [None, [], "text", 3])
def test_no_scenario_at_all(raw: Any) -> None:
    with pytest.raises(ConfigError, match="holds no scenario"):
        parse_scenario(raw, "scenario.yaml")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_scenario(tmp_path / "none.yaml")


def test_other_drives_and_objects_can_be_described() -> None:
    for drive in (
        {"kind": "s_curve", "duration_s": 17.0, "transition_m": 2.0},
        {"kind": "figure_eight", "radius_m": 7.0, "turn": "left"},
        {"kind": "straight", "duration_s": 17.0},
        {"kind": "standstill", "duration_s": 3.0},
    ):
        scenario = parse_scenario({**minimal(), "drive": drive}, "scenario.yaml")
        assert isinstance(scenario, Scenario)
        assert scenario.drive.kind == drive["kind"]


def test_the_config_of_a_recorded_drive_leads_to_plan(tmp_path: Path) -> None:
    path = write_config(tmp_path / "config.yaml")

    with pytest.raises(
        ConfigError, match=r"Make one .* by 'caliv-graph plan .*config\.yaml --out scenario\.yaml'"
    ):
        load_scenario(path)
