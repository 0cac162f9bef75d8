"""``tidegate phantom``: generate the recording of a virtual volunteer, its calibration and its true motion."""

from pathlib import Path
from typing import Annotated

import typer

from engine.core.errors import InvalidValueError, TidegateError
from lab.evaluation.integrity.cases import falsification_of
from lab.phantom.builds import Departure
from lab.phantom.falsifications import Falsification
from lab.phantom.recording import make_volunteer
from lab.phantom.sensor import USUAL
from service.cli.terminal import frame_bar, refused, say


def phantom(
    scenario: Annotated[
        str,
        typer.Argument(
            help="regular, irregular, isovolume, dibh, drift, shift, occlusion or events.", metavar="SCENARIO"
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for recording.oni, calibration.json, truth.npz and flow.csv.")],
    volunteer: Annotated[int, typer.Option(help="Number of the volunteer, 1 to 10.")] = 1,
    seconds: Annotated[float, typer.Option(help="Length of the recording [s].")] = 60.0,
    fps: Annotated[float, typer.Option(help="Nominal frame rate; the actual one is 0.1 % lower [1/s].")] = 30.0,
    seed: Annotated[
        int, typer.Option(help="Seed of the random noise; the same seed gives the same file on the same processor.")
    ] = 1,
    trace: Annotated[
        Path | None, typer.Option(help="Breathing trace to reproduce: a marker CSV, an RPM .vxp or a QA text file.")
    ] = None,
    camera_mm: Annotated[float | None, typer.Option(help="Distance from the camera to the chest [mm].")] = None,
    amplitude_mm: Annotated[float | None, typer.Option(help="Amplitude of the abdomen in free breathing [mm].")] = None,
    hole_share: Annotated[float | None, typer.Option(help="Share of the body without depth values, 0 to 1.")] = None,
    drift_mm: Annotated[
        float | None, typer.Option(help="How far a cold camera's readings are off at the start [mm]; fades in minutes.")
    ] = None,
    light: Annotated[float | None, typer.Option(help="Light of the room, as a share of the usual.")] = None,
    shadow: Annotated[
        float | None, typer.Option(help="Share of the light that the gantry takes; its shadow comes and goes.")
    ] = None,
    skin: Annotated[int | None, typer.Option(help="Type of skin, 1 to 6 (Fitzpatrick).")] = None,
    clothing: Annotated[
        str | None, typer.Option(help="In place of the own shirt: white, black, striped, or bare for skin.")
    ] = None,
    sticker: Annotated[str | None, typer.Option(help="plain, or ringed: a white dot on a black disc.")] = None,
    extra_markers: Annotated[
        bool,
        typer.Option(
            "--extra-markers", help="Add two stickers at the costal margin, which separate thorax from abdomen."
        ),
    ] = False,
    laser: Annotated[
        bool, typer.Option("--laser", help="Project a laser line onto the body; also writes plane.json.")
    ] = False,
    sensor: Annotated[
        str,
        typer.Option(
            help="Model of the sensor's errors: usual (structured-light), locking, whose errors follow the sub-pixel "
            "phase, active-stereo or time-of-flight."
        ),
    ] = USUAL,
    falsify: Annotated[
        str | None,
        typer.Option(
            help='Kind of a false recording, as `tidegate evaluate integrity` lists them, e.g. "couch lowered".',
            metavar="KIND",
        ),
    ] = None,
    size: Annotated[str | None, typer.Option(help='Its size, e.g. "2 mm".')] = None,
    falsify_at: Annotated[float, typer.Option(help="When it begins [s].", min=0.0, max=3600.0)] = 30.0,
    workers: Annotated[int | None, typer.Option(help="Number of processes; one per core by default.")] = None,
) -> None:
    """Generate a recording of a virtual volunteer, with its calibration and true motion.

    A breathing person on a couch, recorded by a simulated camera with the noise, quantisation and gaps of the real one.
    With --falsify something is false from some time on: a sheet, a couch that moves, a marker put elsewhere.
    """
    try:
        false = _falsification(falsify, size, falsify_at, seconds)
        with frame_bar() as progress:
            task = progress.add_task(f"volunteer {volunteer}, {scenario}", total=None)
            make_volunteer(
                scenario,
                volunteer=volunteer,
                seconds=seconds,
                fps=fps,
                seed=seed,
                out=out,
                trace=trace,
                departure=Departure(
                    camera_mm=camera_mm,
                    amplitude_mm=amplitude_mm,
                    hole_share=hole_share,
                    drift_mm=drift_mm,
                    light=light,
                    shadow=shadow,
                    skin=skin,
                    clothing=clothing,
                    sticker=sticker,
                ),
                has_laser=laser,
                has_extra_markers=extra_markers,
                sensor=sensor,
                falsification=false,
                workers=workers,
                on_progress=lambda done, total: progress.update(task, completed=done, total=total),
            )
    except TidegateError as error:
        raise refused("phantom", error) from error
    except OSError as error:
        raise refused("phantom", f"{out} cannot be written ({error.strerror or error})") from error
    say(f"Written to {out}")


def _falsification(kind: str | None, size: str | None, start_s: float, seconds: float) -> Falsification | None:
    if kind is None:
        if size is not None:
            raise InvalidValueError("falsify", None, "given where a size is")
        return None
    if start_s >= seconds:
        raise InvalidValueError("falsify_at", start_s, f"before the end, {seconds:g} s")
    return falsification_of(kind, size, start_s=start_s)
