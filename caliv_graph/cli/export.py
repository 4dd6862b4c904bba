"""`caliv-graph export`: a calibration in the format of a localiser, robot model or program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, CalibrationArgument, Force
from caliv_graph.export.consumers import consumer_names

if TYPE_CHECKING:
    from caliv_graph.export.request import Export, Request

_POSE = "x,y,z,roll,pitch,yaw"


def _known_consumer(name: str) -> str:
    names = consumer_names()
    if name not in names:
        raise typer.BadParameter(f"'{name}' is not one of {', '.join(names)}.")
    return name


def export(
    calibration: CalibrationArgument,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar=f"[{'|'.join(consumer_names())}]",
            callback=_known_consumer,
            help="The program that reads the file.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE",
            help="The file to write. tf: .sh gives lines of static_transform_publisher, .py a "
            "launch file, .mcap a bag with /tf_static. gtsam: also writes a YAML beside it.",
        ),
    ],
    base: Annotated[
        Path | None,
        typer.Option(
            "--base",
            metavar="OLD",
            help="An existing file of the program: a copy with new numbers is written.",
        ),
    ] = None,
    lidar: Annotated[
        list[str] | None,
        typer.Option("--lidar", metavar="NAME", help="Only this LiDAR; may be repeated."),
    ] = None,
    frame: Annotated[
        list[str] | None,
        typer.Option(
            "--frame",
            metavar="NAME=FRAME",
            help="Link or frame of the LiDAR there. Default: the one with a similar name.",
        ),
    ] = None,
    housing: Annotated[
        list[str] | None,
        typer.Option(
            "--housing",
            metavar="NAME=xyz,rpy",
            help=f"The frame of the LiDAR's clouds in that of its housing, {_POSE} in metres and "
            "radians: the pose of the housing is written.",
        ),
    ] = None,
    parent: Annotated[
        list[str] | None,
        typer.Option(
            "--parent",
            metavar="FRAME=xyz,rpy",
            help="Pose of a parent frame in the vehicle frame, such as Autoware's sensor kit.",
        ),
    ] = None,
    vehicle_frame: Annotated[
        str, typer.Option("--vehicle-frame", metavar="FRAME", help="Default: base_link.")
    ] = "",
    imu: Annotated[
        str,
        typer.Option(
            "--imu",
            metavar="xyz,rpy",
            help=f"T_vehicle_imu, {_POSE} in metres and radians. Default: that of the config.",
        ),
    ] = "",
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            metavar="CONFIG",
            help="For topics and the IMU. Default: config.yaml beside CALIBRATION.yaml.",
        ),
    ] = None,
    bag: Annotated[
        Path | None,
        typer.Option(
            "--bag", metavar="DRIVE", help="A recording: frames and housings from its /tf_static."
        ),
    ] = None,
    letter: Annotated[
        str,
        typer.Option(
            "--letter", metavar="C", help="gtsam: letter of the keys; the LiDARs count from 0."
        ),
    ] = "",
    form: Annotated[
        str,
        typer.Option(
            "--form",
            help="tf: lines, launch or mcap; default: by the suffix of --out. lio-sam, fast-lio: "
            "ros2 (default) or ros1.",
        ),
    ] = "",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a calibration for the stack that uses it: URDF, tf2, Autoware, LIO configs, GTSAM.

    A comment in every file states the direction of its transforms and the axes that the drive did
    not determine. With --base, an existing file is copied, and only its numbers change.

    Example: caliv-graph export result/calibration.yaml --to urdf --base old.urdf --out new.urdf
    """
    from caliv_graph.common.files import atomic_write, check_output_file
    from caliv_graph.export.consumers import export as export_to
    from caliv_graph.export.prepare import CONFIG_FILE, Options, prepare
    from caliv_graph.export.text import caveats

    # Not the base: to replace its numbers is what is asked for then.
    inputs = [calibration, config or calibration.parent / CONFIG_FILE, bag]
    check_output_file(out, force, inputs)
    options = Options(
        consumer=to,
        out=out,
        base=base,
        lidars=lidar or (),
        frames=frame or (),
        housings=housing or (),
        parents=parent or (),
        vehicle_frame=vehicle_frame,
        imu=imu,
        config=config,
        bag=bag,
        letter=letter,
        form=form,
    )
    request = prepare(calibration, options)
    exported = export_to(to, request)
    for path in exported.beside:
        check_output_file(path, force, inputs)
    for path, content in {**exported.beside, out: exported.content}.items():
        atomic_write(path, content, force)
    exported_lidars = dict.fromkeys(transform.lidar for transform in exported.transforms)
    warnings = [*exported.warnings, *caveats(request, exported_lidars)]
    if as_json:
        streams.show_json(_document(to, request, exported, warnings))
    else:
        _say(request, exported)
    streams.warn(warnings)


def _say(request: Request, exported: Export) -> None:
    from caliv_graph.export.text import undetermined_axes

    for transform in exported.transforms:
        axes = undetermined_axes(request.calibration.lidars[transform.lidar])
        held = f"; not determined by the drive: {', '.join(axes)}" if axes else ""
        streams.say(f"{transform.lidar}: pose of '{transform.child}' in '{transform.parent}'{held}")
    streams.say(f"{', '.join(str(path) for path in (request.out, *exported.beside))} written")


def _document(to: str, request: Request, exported: Export, warnings: list[str]) -> dict[str, Any]:
    from caliv_graph.export.text import quaternion_xyzw, undetermined_axes

    return {
        "to": to,
        "files": [str(request.out), *map(str, exported.beside)],
        "status": request.calibration.status,
        "transforms": [
            {
                "lidar": transform.lidar,
                "parent": transform.parent,
                "child": transform.child,
                "translation": transform.T_parent_child.translation().tolist(),
                "quaternion_xyzw": list(quaternion_xyzw(transform.T_parent_child)),
                "undetermined": undetermined_axes(request.calibration.lidars[transform.lidar]),
            }
            for transform in exported.transforms
        ],
        "warnings": warnings,
    }
