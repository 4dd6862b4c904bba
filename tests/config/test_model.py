from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from caliv_graph.config.lidars import PoseSigmaConfig
from caliv_graph.config.load import dump_config, load_config, parse_config, read_yaml
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import GnssConfig, ImuConfig
from caliv_graph.errors import ConfigError

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

REGION = {"min": [10, -14, -1], "max": [20, -4, 3]}

SPECIFICATION = """\
data: {format: rosbag, path: drive/}
topics: {imu: /imu/data, gnss: /gnss/fix, twist: /vehicle/twist}
lidars:
  front: {topic: /lidar/front/points, initial: {xyz: [2, 0, 2], rpy_deg: [0, 10, 0]},
          sigma: {xyz: 0.058, rpy_deg: 1.73}}
  rear: {topic: /lidar/rear/points, initial: {xyz: [-0.4, 0, 2], rpy_deg: [0, 10, 180]},
         sigma: {xyz: 0.058, rpy_deg: 1.73}}
reference: rear
target: {min: [10, -14, -1], max: [20, -4, 3], frame: map}
ground: {use: true, vehicle_height: 0.0, sigma: 0.005}
imu: {T_vehicle_imu: {xyz: [0, 0, 0], rpy_deg: [0, 0, 0]}}
gnss: {lever_arm: [0, 0, 0]}
noise: {}
solve: {mode: auto, time_offset: false}
robust: {kernel: huber}
require: [s2s]
"""


def parse(base: Path = Path("/base"), **sections: Any) -> Config:
    lidars = {
        "front": {"topic": "a", "initial": {"xyz": [0, 0, 0]}},
        "rear": {"topic": "b", "initial": {"xyz": [0, 0, 0]}},
    }
    return parse_config({"lidars": lidars, **sections}, "config.yaml", base)


def error_of(**sections: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        parse(**sections)
    message = str(caught.value)
    assert message.startswith("config.yaml: ")
    assert "\n" not in message
    return message.removeprefix("config.yaml: ")


def lidar(**keys: Any) -> dict[str, Any]:
    return {"front": {"topic": "a", "initial": {"xyz": [0, 0, 0]}, **keys}}


def test_the_example_of_the_specification() -> None:
    config = parse_config(yaml.safe_load(SPECIFICATION), "config.yaml", Path("/base"))

    assert config.data.path == Path("/base/drive")
    assert config.lidar_order() == ("front", "rear")
    assert config.reference == "rear"
    assert config.require == ("s2s",)
    assert config.ground.vehicle_height == 0.0


def test_staged_may_fix_the_reference() -> None:
    lidars = {**lidar(fixed=True), "rear": {**lidar()["front"], "topic": "b"}}
    assert parse(lidars=lidars, reference="front", solve={"mode": "staged"}).lidars["front"].fixed


def test_defaults() -> None:
    config = parse()

    assert config.reference == "front"
    assert config.require == ("s2s",)
    assert config.limits == {}
    assert config.solve.mode == "auto"
    assert config.robust.kernel == "huber"
    assert config.ground.use
    assert config.ground.vehicle_height is None
    assert config.target is None
    assert config.data.path is None


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"solv": {}}, "unknown key 'solv': did you mean 'solve'?"),
        ({"solve": {"mod": "auto"}}, "unknown key 'solve.mod': did you mean 'mode'?"),
        ({"noise": {"lidar_range": 1}}, "unknown key 'noise.lidar_range': did you mean "
         "'lidar_range_m'?"),
        ({"lidars": lidar(min_rang=1)}, "unknown key 'lidars.front.min_rang': did you mean "
         "'min_range'?"),
        ({"lidars": lidar(initial={"xy": [1, 2, 3]})}, "unknown key 'lidars.front.initial.xy': "
         "did you mean 'xyz'?"),
        ({"imu": {"T_vehicle_imu": {"rpy": [0, 0, 0]}}}, "unknown key 'imu.T_vehicle_imu.rpy': "
         "did you mean 'rpy_deg'?"),
        ({"target": {**REGION, "fram": "map"}}, "unknown key 'target.0.fram': did you mean "
         "'frame'?"),
        ({"target": [REGION, {**REGION, "fram": "map"}]}, "unknown key 'target.1.fram': did you "
         "mean 'frame'?"),
        ({"robust": {"zzz": 1}}, "unknown key 'robust.zzz': known keys: huber_k, kernel, "
         "tls_p_value, trim_percent"),
    ],
)  # fmt: skip
def test_an_unknown_key_names_the_nearest(sections: dict[str, Any], message: str) -> None:
    assert error_of(**sections) == message


@pytest.mark.parametrize(
    ("sections", "part"),
    [
        ({"lidars": {}}, "'lidars': "),
            ({"lidars": {"front": {"topic": "a", "fixed": True}}}, "and initial is not given"),
            ({"lidars": {"front": {"topic": "a"}}, "solve": {"mode": "staged"}},
             "lidars.front.initial is not given"),
        ({"lidars": {**lidar(fixed=True), "rear": {**lidar()["front"], "topic": "b"}},
          "reference": "rear", "solve": {"mode": "staged"}},
         "of the reference 'rear', which would move lidars.front, whose guess is fixed: set "
         "reference to front, or mode to auto"),
        ({"lidars": lidar(initial={"xyz": [0, math.nan, 0]})}, "'lidars.front.initial.xyz.1': "
         "must be a finite number (got 'nan')"),
        ({"lidars": lidar(initial={"xyz": [0, 0]})}, "'lidars.front.initial.xyz.2' is missing"),
        ({"lidars": lidar(sigma={"xyz": 0})}, "'lidars.front.sigma.xyz"),
        ({"lidars": lidar(sigma={"xyz": [1, 2]})}, "'lidars.front.sigma.xyz"),
        ({"lidars": lidar(min_range=5, max_range=4)}, "min_range (5.0 m) must be below max_range "
         "(4.0 m)"),
        ({"lidars": {**lidar(), "rear": lidar()["front"]}},
         "topic 'a' belongs to LiDARs 'front' and 'rear'"),
        ({"reference": "roof"}, "'roof' is not a LiDAR of this config: set it to one of"),
        ({"target": {"min": [0, 0, 0], "max": [1, 0, 1]}}, "min y (0.0 m) must be below max y "
         "(0.0 m)"),
        ({"target": {"min": [0, 0, 0], "max": [1, 1, math.inf]}}, "must be a finite number"),
        ({"robust": {"kernel": "hubr"}}, "'robust.kernel': "),
        ({"require": ["s2x"]}, "'require.0': "),
        ({"limits": {"s2v_yaw": 0.1}}, "unknown limit 's2v_yaw'"),
        ({"limits": {"s2v_yaw_deg": 0}}, "'limits.s2v_yaw_deg': "),
        ({"extraction": {"min_points": 10.5}}, "'extraction.min_points': "),
        ({"lidars": {"float": lidar(min_range=-1)["front"]}}, "'lidars.float.min_range': "),
        ({"lidars": {"up[1]": lidar(sigma={"xyz": 0})["front"]}}, "'lidars.up[1].sigma.xyz': "),
        ({"solve": 3}, "'solve': must be keys with values (got '3')"),
        ({"ground": {"vehicle_height": 350}}, "'ground.vehicle_height': must be within 30 m of "
         "the ground: in metres, not millimetres (got '350')"),
        ({"ground": {"vehicle_height": -35.0}}, "'ground.vehicle_height': must be within 30 m"),
        ({"noise": {"lidar_range_m": 10}}, "'noise.lidar_range_m': must be at most 1 m: in metres, "
         "not millimetres (got '10')"),
        ({"extraction": {"ground_distance": 50}}, "'extraction.ground_distance': must be at most "),
    ],
)  # fmt: skip
def test_what_is_not_valid_is_named_with_its_place(sections: dict[str, Any], part: str) -> None:
    assert part in error_of(**sections)


@pytest.mark.parametrize("height_m", [0.0, -0.4, 7.5, 25.0])
def test_heights_that_vehicles_have(height_m: float) -> None:
    """Of a frame in the road, of a mining truck, of a container crane."""
    sections = {"lidars": lidar(), "ground": {"vehicle_height": height_m}}
    assert Config.model_validate(sections).ground.vehicle_height == height_m


@pytest.mark.parametrize("name", ["", " front", "a\nb", "\x1b[31mred", "\u2028", "x" * 101, "\t"])
def test_a_name_that_no_table_could_show(name: str) -> None:
    message = error_of(lidars={name: lidar()["front"]})

    assert f"{name[:40]!r} cannot be the name of a LiDAR" in message
    assert message.isprintable()


@pytest.mark.parametrize("name", ["front", "Ouster OS-1", "../../x", "<b>", "vorn-rechts é", "1"])
def test_names_that_are_only_odd(name: str) -> None:
    assert list(parse(lidars={name: lidar()["front"]}).lidars) == [name]


def test_an_unknown_key_with_brackets_is_named() -> None:
    """It looks like one of pydantic's own, which are left out of the place."""
    assert "unknown key 'lidars.front.xyz[0]'" in error_of(lidars=lidar(**{"xyz[0]": 1}))


def test_several_errors_are_counted() -> None:
    assert error_of(solv={}, robst={}).endswith("(and 1 more)")


@pytest.mark.parametrize("raw", [None, [], "text", 5])
def test_what_is_no_mapping(raw: Any) -> None:
    with pytest.raises(ConfigError, match="holds no configuration"):
        parse_config(raw, "config.yaml", Path())


@pytest.mark.parametrize(
    ("require", "names", "limits"),
    [
        ([], (), {}),
        ("s2v", ("s2v",), {}),
        (["s2s", "s2v_rotation"], ("s2s", "s2v_rotation"), {}),
        ({"limits": {"s2v_yaw_deg": 0.1}}, (), {"s2v_yaw_deg": 0.1}),
        ([{"limits": {"s2v_yaw_deg": 0.1}}], (), {"s2v_yaw_deg": 0.1}),
        (["s2s", {"limits": {"s2s_x_m": 0.01}}], ("s2s",), {"s2s_x_m": 0.01}),
        (["s2s", {"s2s_x_m": 0.1}, {"s2v_z_m": 0.2}], ("s2s",), {"s2s_x_m": 0.1, "s2v_z_m": 0.2}),
    ],
)  # fmt: skip
def test_forms_of_require(require: Any, names: tuple[str, ...], limits: dict[str, float]) -> None:
    config = parse(require=require)

    assert (config.require, config.limits) == (names, limits)


def test_limits_at_the_top_and_in_require_add_up() -> None:
    config = parse(require=["s2v", {"limits": {"s2v_x_m": 0.1}}], limits={"s2s_yaw_deg": 0.2})

    assert config.require == ("s2v",)
    assert config.limits == {"s2s_yaw_deg": 0.2, "s2v_x_m": 0.1}
    assert parse(limits={"s2s_yaw_deg": 0.2}).require == ("s2s",)


def test_one_target_or_several() -> None:
    one, two = (
        parse(target=REGION).target,
        parse(target=[REGION, {**REGION, "frame": "start"}]).target,
    )

    assert one
    assert two
    assert [region.frame for region in one] == ["map"]
    assert [region.frame for region in two] == ["map", "start"]


def test_no_target_is_looked_for_if_the_config_says_so() -> None:
    config = parse(target=False)

    assert config.target is False
    assert yaml.safe_load(dump_config(config))["target"] is False
    assert config.structure.use
    for contradiction in ({"structure": {"use": False}}, {"solve": {"mode": "staged"}}):
        with pytest.raises(ConfigError, match="target: false leaves structure alone"):
            parse(target=False, **contradiction)


def test_sigmas_are_one_number_or_three() -> None:
    assert PoseSigmaConfig(xyz=0.1).xyz_m() == (0.1, 0.1, 0.1)
    assert PoseSigmaConfig(xyz=(0.1, 0.2, 0.3)).xyz_m() == (0.1, 0.2, 0.3)
    assert PoseSigmaConfig(rpy_deg=(180.0, 90.0, 1.8)).rpy_rad() == pytest.approx(
        (math.pi, math.pi / 2, math.pi / 100)
    )


def test_a_config_does_not_change() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        parse().solve.mode = "joint"  # type: ignore[misc]


def test_what_is_dumped_is_loaded_again(tmp_path: Path) -> None:
    config = parse(
        tmp_path,
        data={"format": "caliv", "path": "drive"},
        reference="rear",
        target=[REGION, {**REGION, "frame": "start"}],
        noise={"pose_position_m": 1e-5},
        require=["s2v", {"limits": {"s2v_yaw_deg": 0.1}}],
        solve={"mode": "staged"},
    )
    path = tmp_path / "elsewhere.yaml"
    path.write_text(dump_config(config))

    assert load_config(path) == config
    assert dump_config(load_config(path)) == dump_config(config)


@pytest.mark.parametrize("arm", [None, [0.0, 0.0, 0.0], [1.0, 0.0, 2.0]])
@pytest.mark.parametrize("rpy_deg", [None, [0.0, 0.0, 0.0], [0.0, 0.0, 90.0]])
def test_what_is_unknown_stays_unknown_in_the_dump(arm: Any, rpy_deg: Any) -> None:
    config = parse(
        gnss={"lever_arm": arm},
        imu={"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": rpy_deg}},
        lidars={"a": {"topic": "a"}, "b": {"topic": "b", "initial": {"xyz": [1, 0, 0]}}},
    )
    dumped = dump_config(config)
    again = parse_config(yaml.safe_load(dumped), "config.yaml", Path("/base"))

    assert again == config
    assert again.gnss.arm_sigma() == config.gnss.arm_sigma()
    # What was not given is not written.
    assert dumped.count("null") == (arm is None) + (rpy_deg is None)


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "broken.yaml").write_text("a: 1\nb: [1\nc: 2\n")
    (tmp_path / "empty.yaml").write_text("")
    (tmp_path / "folder").mkdir()

    for name, part in {
        "nowhere.yaml": "no such file. Write it for a drive by 'caliv-graph init DRIVE --out",
        "x" * 300: "File name too long",
        "folder": "is a folder, expected a YAML file. If this is a drive, write one by",
        "binary.yaml": "is not text in UTF-8",
        "broken.yaml": "not valid YAML in line 3",
        "empty.yaml": "holds no configuration",
    }.items():
        with pytest.raises(ConfigError) as caught:
            load_config(tmp_path / name)
        assert part in str(caught.value)
        assert str(caught.value).startswith(str(tmp_path))


def test_the_folder_of_a_config_leads_to_it(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("lidars: {}")

    with pytest.raises(ConfigError, match=r"is a folder\. Give .*config\.yaml"):
        load_config(tmp_path)


def test_the_folder_of_a_result_names_what_to_give(tmp_path: Path) -> None:
    for name in ("calibration.yaml", "config.yaml", "metadata.yaml", "report.html"):
        (tmp_path / name).write_text("a: 1")

    with pytest.raises(ConfigError) as caught:
        read_yaml(tmp_path)

    files = f"{tmp_path / 'calibration.yaml'}, {tmp_path / 'config.yaml'}"
    assert str(caught.value) == f"{tmp_path}: is a folder. Give one of its files: {files}"
    # That of a bag is none: a drive needs a config.
    (tmp_path / "calibration.yaml").unlink()
    (tmp_path / "config.yaml").unlink()
    with pytest.raises(ConfigError, match=r"If this is a drive, write one by 'caliv-graph init"):
        read_yaml(tmp_path)


def test_names_of_digits_are_text(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(
        "data: {path: 0001}\nreference: 2\n"
        "lidars: {2: {topic: 7, initial: {xyz: [0, 0, 1]}}, "
        "03: {topic: a, initial: {xyz: [1, 0, 1]}}}"
    )

    config = load_config(path)

    assert config.data.path == tmp_path / "0001"
    assert list(config.lidars) == ["2", "03"]
    assert (config.reference, config.lidars["2"].topic) == ("2", "7")
    path.write_text("data: {path: 1.50}\nlidars: {a: {topic: a, initial: {xyz: [0, 0, 1]}}}")
    with pytest.raises(ConfigError, match=r"'data\.path': is not text in YAML: write it in quotes"):
        load_config(path)


def keys_of(model: type[BaseModel], at: str = "") -> Iterator[str]:
    """Dotted names of all keys of a model; `*` for the entries of a dictionary."""
    for name, field in model.model_fields.items():
        yield at + name
        for inner, below in models_in(field.annotation):
            yield from keys_of(inner, f"{at}{name}.{below}")


def models_in(annotation: Any) -> Iterator[tuple[type[BaseModel], str]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, ""
    elif get_origin(annotation) is dict:
        yield from ((model, "*.") for model, _ in models_in(get_args(annotation)[1]))
    elif get_origin(annotation) in (tuple, Union, UnionType, Annotated):
        for argument in get_args(annotation):
            yield from models_in(argument)


def keys_in(document: Mapping[str, Any], at: str = "") -> Iterator[str]:
    for key, value in document.items():
        name = "*" if at == "lidars." else key
        if name != "*":
            yield at + name
        if isinstance(value, Mapping):
            yield from keys_in(value, f"{at}{name}.")


def test_the_config_of_the_published_drive_has_every_key() -> None:
    document = yaml.safe_load((CONFIGS / "caliv_released.yaml").read_text())

    assert set(keys_in(document)) == set(keys_of(Config))


def test_the_config_of_the_published_drive_has_a_comment_on_every_key() -> None:
    lines = (CONFIGS / "caliv_released.yaml").read_text().splitlines()

    bare = [line for line in lines if ":" in line and " # " not in f" {line}"]

    # Sections that are about one thing only say it below.
    assert bare == ["data:", "imu:", "gnss:", "solve:", "robust:"]


def test_the_config_of_the_published_drive_shows_the_defaults() -> None:
    config = load_config(CONFIGS / "caliv_released.yaml")
    lidars = {
        name: {"topic": given.topic, "initial": given.initial}
        for name, given in config.lidars.items()
    }
    defaults = Config.model_validate({"lidars": lidars})

    for section in ("topics", "imu", "gnss", "noise", "solve", "robust", "extraction"):
        assert getattr(config, section) == getattr(defaults, section)
    for section in ("registration", "require", "limits"):
        assert getattr(config, section) == getattr(defaults, section)
    assert config.ground == defaults.ground.model_copy(update={"use": False})
    assert config.lidars["sensor_1"] == defaults.lidars["sensor_1"]
    assert config.lidars["sensor_2"].sigma.xyz_m() == defaults.lidars["sensor_2"].sigma.xyz_m()


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"limits": 5, "require": ["s2s"]}, "'limits': must be keys with values"),
        ({"require": [{"limits": [1]}]}, "'limits': must be keys with values"),
        ({"target": {"min": [0, 0, 0], "mx": [1, 1, 1]}}, "unknown key 'target.0.mx'"),
        ({"target": []}, "'target': must have 1 or more items, has 0"),
        (
            {
                "lidars": {
                    "front": {"topic": "a", "initial": {"xyz": [0, 0, 0]}, "sigma": {"xyz": -1}}
                }
            },
            "'lidars.front.sigma.xyz':",
        ),
        (
            {"lidars": {"initial": {"topic": "a", "initial": {"xyz": [0, 0, 0]}, "min_rang": 1}}},
            "unknown key 'lidars.initial.min_rang': did you mean 'min_range'?",
        ),
        ({"reference": "left"}, "reference 'left' is not a LiDAR of this config"),
    ],
)
def test_what_is_wrong_is_said_where_it_is(sections: dict[str, Any], message: str) -> None:
    assert error_of(**sections).startswith(message)


def test_an_empty_section_means_its_defaults() -> None:
    assert parse(topics=None, noise=None) == parse()


def test_a_key_that_stands_twice_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("lidars:\n  front: {topic: a}\n  front: {topic: b}\n")

    with pytest.raises(ConfigError, match="in line 3: key 'front' is given twice"):
        load_config(path)


@pytest.mark.parametrize(
    ("gnss", "sigma_m"),
    [
        ({}, None),
        ({"lever_arm": [0, 0, 0]}, None),
        ({"lever_arm": [0, 0, 0], "lever_arm_sigma": 0.02}, 0.02),
        ({"lever_arm": [0, 0, 1.5]}, 0.01),
        ({"lever_arm": None}, 2.0),
        ({"lever_arm": None, "lever_arm_sigma": 0.5}, 0.5),
    ],
)
def test_the_sigma_of_a_lever_arm(gnss: dict[str, object], sigma_m: float | None) -> None:
    assert GnssConfig.model_validate(gnss).arm_sigma() == sigma_m


@pytest.mark.parametrize(
    ("imu", "sigma_deg"),
    [
        ({}, None),
        ({"T_vehicle_imu": {"xyz": [0, 0, 0]}}, None),
        ({"T_vehicle_imu": {"xyz": [0, 0, 0]}, "rotation_sigma_deg": 1.0}, 1.0),
        ({"T_vehicle_imu": {"xyz": [0.5, 0, 0]}}, 0.1),
        ({"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 90]}}, 0.1),
        ({"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": None}}, None),
    ],
)
def test_the_sigma_of_the_imu_s_rotation(imu: dict[str, object], sigma_deg: float | None) -> None:
    sigma = ImuConfig.model_validate(imu).rotation_sigma_rad()
    assert sigma == (None if sigma_deg is None else pytest.approx(math.radians(sigma_deg)))


@pytest.mark.parametrize(
    ("imu", "sigma_m"),
    [
        ({}, None),
        ({"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 90]}}, None),
        ({"T_vehicle_imu": {"xyz": [0, 0, 0]}, "xyz_sigma": 0.02}, 0.02),
        ({"T_vehicle_imu": {"xyz": [0.5, 0, 0], "rpy_deg": None}}, 0.01),
    ],
)
def test_the_sigma_of_the_imu_s_place(imu: dict[str, object], sigma_m: float | None) -> None:
    assert ImuConfig.model_validate(imu).place_sigma() == sigma_m


def test_what_is_unknown_has_no_sigma_left_over_from_when_it_was_known() -> None:
    """Taken as the prior of the guess, it gave an IMU that is 30 degrees off with exit 4."""
    with pytest.raises(ValueError, match=r"known to 0\.1 degrees: remove rotation_sigma_deg"):
        ImuConfig.model_validate(
            {"T_vehicle_imu": {"xyz": [1, 0, 0], "rpy_deg": None}, "rotation_sigma_deg": 0.1}
        )
    with pytest.raises(ValueError, match=r"within 0.01 m of the vehicle's origin: remove"):
        GnssConfig.model_validate({"lever_arm": None, "lever_arm_sigma": 0.01})


def test_an_unknown_rotation_is_no_pose() -> None:
    config = ImuConfig.model_validate({"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": None}})
    with pytest.raises(ConfigError, match="the rotation of the IMU is unknown"):
        config.T_vehicle_imu.pose()


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "me"))
    named = {"path": "~/drive", "poses": "~nobody-here/poses.txt"}
    raw = {"data": named, "lidars": {"a": {"topic": "/a"}}}
    data = parse_config(raw, "config.yaml", tmp_path / "configs").data
    assert data.path == tmp_path / "me" / "drive"
    # No such person: the path as it stands.
    assert data.poses == tmp_path / "configs" / "~nobody-here" / "poses.txt"
