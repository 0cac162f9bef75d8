"""``tidegate devices``: the connected cameras, a camera's own calibration, and a camera looked at before its use."""

import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from engine.core.errors import FrameTimeoutError, InvalidValueError, SourceLostError, TidegateError
from service.cli.command_group import command_group
from service.cli.terminal import refused, say

if TYPE_CHECKING:
    from engine.capture import LiveSource
    from engine.qa import DeviceCheck, DeviceFinding

READ_S = 1.0
REPLUG_S = 120.0
devices = command_group(
    "devices", "List the cameras, write a camera's own calibration, check a camera before it is used."
)
Address = Annotated[
    str | None,
    typer.Option("--source", help="Address of a camera, as `tidegate devices list` prints it; the first one."),
]


@devices.command("list")
def list_devices() -> None:
    """Print every kind of cameras with what is missing, and the connected cameras."""
    from engine.capture import drivers
    from engine.core.plug_ins import BEAM_LINES, CAMERAS, find_plug_ins

    kinds = Table("kind", "installed", "installed by", show_edge=False)
    console = Console()
    try:
        drivers.add_cameras(find_plug_ins(CAMERAS))
        for kind in drivers.kinds():
            kinds.add_row(escape(kind.label), "yes" if kind.is_installed else "no", escape(kind.install_hint))
        console.print(kinds)
        for plug_in in (*find_plug_ins(CAMERAS), *find_plug_ins(BEAM_LINES)):
            say(f"Plug-in {plug_in.label}: {plug_in.group}, {plug_in.name}={plug_in.sha256 or 'installed for editing'}")
        found = drivers.list_cameras()
    except TidegateError as error:
        raise refused("devices", error) from error
    cameras = Table("address", "camera", show_edge=False)
    for one in found:
        cameras.add_row(escape(one.uri), escape(f"{one.vendor} {one.name}".strip()))
    console.print(cameras if found else drivers.none_text())


@devices.command()
def calibration(
    out: Annotated[Path, typer.Option("--out", help="The calibration file to write.", show_default=False)],
    source: Address = None,
) -> None:
    """Write the calibration that a camera brings itself, by its maker or by its registration.

    The source may also be a recording of a maker's SDK (.bag, .db3). Check it with a plate before it is uploaded.
    """
    from engine.calibration import built_in_calibration
    from engine.capture import drivers
    from engine.core.files import write_whole
    from engine.core.plug_ins import CAMERAS, find_plug_ins

    try:
        drivers.add_cameras(find_plug_ins(CAMERAS))
        made = None if source is None else drivers.maker_recording(Path(source))
        found = built_in_calibration(made or drivers.listed_address(source))
        if found is None:
            msg = "this camera neither registers depth to colour itself nor has a calibration of its maker"
            raise SourceLostError(msg)
        # Without the mark of what a camera brings itself: who checks it with a plate and uploads it answers for it.
        found = replace(found, camera=f"{found.camera.partition(': ')[2]}, by its maker"[:80])
        write_whole(out, found.to_json().encode())
    except (TidegateError, OSError) as error:
        raise refused("devices", error) from error
    sys.stdout.write(f"{found.camera}, serial {found.serial or 'unknown'}: written to {out}\n")


@devices.command()
def check(
    source: Address = None,
    seconds: Annotated[float, typer.Option(help="How long to look [s].", min=5.0, max=7200.0)] = 60.0,
    out: Annotated[
        Path | None, typer.Option("--out", help="File for the figures, as JSON, to send with a report.")
    ] = None,
    calibration_file: Annotated[
        Path | None,
        typer.Option("--calibration", help="Its calibration, for the shape of the surface; else its maker's."),
    ] = None,
    radius_mm: Annotated[
        float | None,
        typer.Option(
            "--radius-mm", help="Radius of a drum that it looks at, in place of a plane.", min=30.0, max=1000.0
        ),
    ] = None,
    *,
    is_replugged: Annotated[
        bool, typer.Option("--replug", help="Ask to pull the cable and plug it in again, and time the return.")
    ] = False,
) -> None:
    """Look at a still, flat surface and judge rates, losses, clock, noise, drift and flatness.

    Point the camera at the bare couch, or at a drum of known radius across the middle of the picture; let it run for
    half an hour to see its warm-up (--seconds 1800). Exit code 1 when a figure fails.
    """
    from engine.calibration import built_in_calibration, load_calibration
    from engine.capture import drivers
    from engine.core.clock import MonotonicClock
    from engine.core.files import write_whole
    from engine.core.plug_ins import CAMERAS, find_plug_ins
    from engine.qa import DeviceCheck

    camera = None
    try:
        drivers.add_cameras(find_plug_ins(CAMERAS))
        address = drivers.listed_address(source)
        known = built_in_calibration(address) if calibration_file is None else load_calibration(calibration_file)
        if known is None and radius_mm is not None:
            raise InvalidValueError("radius_mm", radius_mm, "given with --calibration: this camera has none of its own")
        camera = drivers.open_camera(address, clock=MonotonicClock())
        begun_s = time.monotonic()
        depth = None if known is None else known.depth
        checked = DeviceCheck(described=camera.open(), depth=depth, radius_mm=radius_mm)
        _look(camera, checked, seconds)
        opened_s = time.monotonic() - begun_s - seconds
        away_s = _replug(camera, address) if is_replugged else None
        findings = checked.findings()
        if not findings:
            raise SourceLostError(f"only {checked.frames} frames in {seconds:g} s")
        if out is not None:
            write_whole(out, _document(checked, findings, opened_s, away_s).encode())
    except (TidegateError, OSError) as error:
        raise refused("devices", error) from error
    finally:
        if camera is not None:
            camera.close()
    _print(checked, findings, away_s)
    if any(one.verdict == "fail" for one in findings):
        raise typer.Exit(1)


def _look(camera: "LiveSource", checked: "DeviceCheck", seconds: float) -> None:
    from engine.capture import TemperatureSource

    end_s = time.monotonic() + seconds
    with _bar() as bar:
        task = bar.add_task("looking", total=seconds)
        while (left_s := end_s - time.monotonic()) > 0.0:
            try:
                frame = camera.read(READ_S)
                checked.add(frame, camera.temperature_c if isinstance(camera, TemperatureSource) else None)
            except FrameTimeoutError:
                continue
            bar.update(task, completed=seconds - left_s)


def _replug(camera: "LiveSource", address: str) -> float:
    """Ask for the cable to be pulled, wait for the camera's return, and return how long that took [s]."""
    sys.stderr.write("Pull the camera's cable, and plug it in again.\n")
    deadline_s, lost_s = time.monotonic() + REPLUG_S, None
    while time.monotonic() < deadline_s:
        try:
            if lost_s is not None:
                camera.open()
            camera.read(READ_S)
        except FrameTimeoutError:
            continue
        except TidegateError:
            lost_s = time.monotonic() if lost_s is None else lost_s
            camera.close()
            time.sleep(0.5)
            continue
        if lost_s is not None:
            return time.monotonic() - lost_s
    state = "was not pulled" if lost_s is None else f"did not come back as {address}"
    raise SourceLostError(f"the camera {state} within {REPLUG_S:g} s")


def _bar() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty())


def _document(checked: "DeviceCheck", findings: "list[DeviceFinding]", opened_s: float, away_s: float | None) -> str:
    import platform

    from engine import __version__

    content = {
        "schema": "tidegate.device-check/1",
        "software": __version__,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "camera": asdict(checked.described),
        "frames": checked.frames,
        "opened_s": round(opened_s, 2),
        "back_after_replug_s": None if away_s is None else round(away_s, 2),
        "curve": checked.curve(),
        "findings": [{**asdict(one), "verdict": one.verdict} for one in findings],
    }
    return json.dumps(content, indent=2) + "\n"


def _print(checked: "DeviceCheck", findings: "list[DeviceFinding]", away_s: float | None) -> None:
    described = checked.described
    table = Table(
        title=f"{described.name}, serial {described.serial or 'unknown'}", title_justify="left", show_edge=False
    )
    for name in ("figure", "value", "warns at", "fails at", ""):
        table.add_column(name, justify="left" if name in {"figure", ""} else "right")
    for one in findings:
        bounds = ["" if bound is None else f"{bound:g}" for bound in (one.warn, one.fail)]
        table.add_row(one.title, f"{one.value:.3g} {one.unit}".strip(), *bounds, one.verdict)
    console = Console()
    console.print(table)
    if away_s is not None:
        console.print(f"Back {away_s:.1f} s after the cable was pulled.")
