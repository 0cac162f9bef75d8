"""A virtual Orbbec camera: OrbbecSDK's own playback device in whatever process is given its environment."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.support.orbbec.bag import BagFrame, write_bag
from tests.support.virtual_camera.camera import VirtualXtion
from tests.support.virtual_camera.film import COLOR_LAG, Film

SHIM = Path(__file__).parent / "shim"
ROOT = Path(__file__).parents[3]
SERIAL = "CL8F3530034"
URI = f"orbbec:{SERIAL}"
PERIOD_US = 33_190
"""30.13 frames/s: each Femto Bolt has a rate of its own between 30.03 and 30.14."""


def filmed(film: Film, count: int, *, change: Callable[[int, int], tuple[int, int] | None]) -> Iterator[BagFrame]:
    """Return frames of a film in the order of their time.

    ``change`` gets the number and the device time of each depth frame, and returns those that it has, None for a lost
    one; colour frames have the same numbers and are later by a share of the period.
    """
    for i in range(count):
        depth, color = film.pictures(i % film.frames)
        at_us = PERIOD_US * i
        changed = change(i + 1, 2_000_000 + at_us)
        if changed is None:
            continue
        number, timestamp_us = changed
        yield BagFrame(number=number, timestamp_us=timestamp_us, at_us=at_us, picture=depth)
        lag_us = round(COLOR_LAG * PERIOD_US)
        color_us = timestamp_us + lag_us if timestamp_us else 0
        yield BagFrame(number=number, timestamp_us=color_us, at_us=at_us + lag_us, picture=color)


def fed(camera: VirtualXtion, folder: Path) -> dict[str, str]:
    """Return what makes a process see a virtual Xtion as an Orbbec camera: every fault of it reaches the frames."""
    own = camera.environment
    cable(folder).touch()
    return environment(folder, camera.film, 4, block=own["VIRTUAL_XTION"], redist=own["OPENNI2_REDIST"])


def cable(folder: Path) -> Path:
    """Return the file that is there while the camera is plugged in."""
    return folder / "cable"


def environment(
    folder: Path,
    film: Film,
    count: int = 60,
    *,
    connection: str = "USB3.0",
    change: Callable[[int, int], tuple[int, int] | None] = lambda number, us: (number, us),
    **faults: Any,
) -> dict[str, str]:
    """Record a film and return what makes a process see it as a camera; ``hangs`` is a call, "stop"."""
    path = folder / "camera.bag"
    path.unlink(missing_ok=True)
    write_bag(path, film.calibration, filmed(film, count, change=change), serial=SERIAL, connection=connection)
    cable(folder).touch()
    given = {"bag": str(path), "cable": str(cable(folder)), **faults}
    return {"VIRTUAL_ORBBEC": json.dumps(given), "CAMERA_SDK_PATH": f"{SHIM}:{ROOT}"}
