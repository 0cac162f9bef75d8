"""``tidegate phantom``: make a virtual volunteer's recording, with its calibration and the truth."""

from pathlib import Path
from typing import Annotated

import typer

from engine.errors import TidegateError
from engine.phantom.builds import Departure
from engine.phantom.recording import make_volunteer
from service.cli.terminal import frame_bar, refused, say


def phantom(
    scenario: Annotated[
        str,
        typer.Argument(
            help="regular, irregular, isovolume, dibh, drift, shift, occlusion or events.", metavar="SCENARIO"
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for recording.oni, calibration.json, truth.npz and flow.csv.")],
    volunteer: Annotated[int, typer.Option(help="Which of the ten volunteers, 1 to 10.")] = 1,
    seconds: Annotated[float, typer.Option(help="Length of the recording [s].")] = 60.0,
    fps: Annotated[float, typer.Option(help="Nominal frame rate [1/s]; the true one is a thousandth lower.")] = 30.0,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 1,
    trace: Annotated[
        Path | None, typer.Option(help="Recorded breathing to follow: a marker CSV, an RPM .vxp or a QA text.")
    ] = None,
    camera_mm: Annotated[float | None, typer.Option(help="Height of the camera over the chest [mm].")] = None,
    amplitude_mm: Annotated[float | None, typer.Option(help="Amplitude of the abdomen in free breathing [mm].")] = None,
    hole_share: Annotated[float | None, typer.Option(help="Share of the body, 0 to 1, that is not read.")] = None,
    extra_markers: Annotated[
        bool, typer.Option("--extra-markers", help="Two more stickers at the costal margin part thorax from abdomen.")
    ] = False,
    laser: Annotated[bool, typer.Option("--laser", help="Throw a laser's line across it; writes plane.json.")] = False,
    workers: Annotated[int | None, typer.Option(help="Processes; one a processor when not given.")] = None,
) -> None:
    """Make a virtual volunteer: a breathing person on a couch, seen by a camera with every fault of the real one."""
    try:
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
                departure=Departure(camera_mm=camera_mm, amplitude_mm=amplitude_mm, hole_share=hole_share),
                has_laser=laser,
                has_extra_markers=extra_markers,
                workers=workers,
                on_progress=lambda done, total: progress.update(task, completed=done, total=total),
            )
    except TidegateError as error:
        raise refused("phantom", error) from error
    except OSError as error:
        raise refused("phantom", f"{out} cannot be written ({error.strerror or error})") from error
    say(f"Written to {out}")
