"""The camera drivers: one row for each SDK. Nothing outside of an SDK's folder names it."""

import itertools
import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from engine.capture.camera_process.native import FILE
from engine.capture.openni.driver import OpenNiDriver
from engine.capture.orbbec.driver import ORBBEC
from engine.capture.realsense.driver import REALSENSE
from engine.capture.source import (
    AS_IT_IS,
    CameraDriver,
    CameraOptions,
    FactoryCalibration,
    ListedCamera,
    LiveSource,
    RegisteredView,
)
from engine.core.clock import Clock
from engine.core.errors import RecordingError, RuntimeMissingError, SourceLostError
from engine.core.plug_ins import PlugIn, PlugInError

CAMERAS: tuple[CameraDriver, ...] = (REALSENSE, ORBBEC, OpenNiDriver())
"""Every driver; an address belongs to the first whose prefix it begins with, so the one without a prefix is last."""
MAKERS = {b"/device_0/sensor_": REALSENSE, b"/cam/sensor_": ORBBEC}
"""What recordings of a maker's SDK hold: the names of their topics."""
PREFIX = re.compile(r"[a-z][a-z0-9-]{1,30}:")
PLUG_INS: dict[str, PlugIn] = {}
"""The plug-in of each driver that one added, by its prefix."""
SUFFIXES = (".bag", ".db3")
ENDS_BYTES = 1 << 22


def add_cameras(plug_ins: Iterable[PlugIn]) -> None:
    """Load the drivers of plug-ins; those that are there already stay.

    Raises
    ------
    PlugInError
        One cannot be imported, is no `CameraDriver`, or has no prefix of its own.
    """
    global CAMERAS  # noqa: PLW0603 - the table of drivers
    for one in plug_ins:
        if one in PLUG_INS.values():
            continue
        driver = cast("CameraDriver", one.load())
        name = f"the camera plug-in {one.name} ({one.label})"
        missing = [part for part in vars(CameraDriver) if not part.startswith("_") and not hasattr(driver, part)]
        if missing:
            msg = f"{name} lacks {', '.join(missing)}"
            raise PlugInError(msg)
        if not PREFIX.fullmatch(driver.prefix) or any(other.prefix == driver.prefix for other in CAMERAS):
            msg = f"{name} has the prefix {driver.prefix!r}: must be letters and a colon, of no other driver"
            raise PlugInError(msg)
        PLUG_INS[driver.prefix] = one
        CAMERAS = (driver, *CAMERAS)


def is_any_installed() -> bool:
    """Whether the SDK of any driver is on this machine; starts none."""
    return any(driver.is_installed() for driver in CAMERAS)


def is_any_available() -> bool:
    """Whether the SDK of any driver is on this machine and starts."""
    return any(driver.is_available() for driver in CAMERAS)


def missing_text() -> str:
    """Return what is missing where no SDK is available, and how it is installed."""
    return " or ".join(f"{driver.label} is missing: {driver.install_hint}" for driver in CAMERAS)


def list_cameras(pinned: str = "") -> list[ListedCamera]:
    """List the cameras that may be opened: the one at ``pinned``, those whose address begins with it, or all.

    Raises
    ------
    RuntimeMissingError
        No SDK is on this machine.
    """
    available = [driver for driver in _available() if _may_have(driver, pinned)]
    if not available:
        raise RuntimeMissingError(missing_text())
    with ThreadPoolExecutor(len(available)) as pool:  # an SDK in a process of its own takes a second
        answers = list(pool.map(_listed, available))
    failed = [answer for answer in answers if isinstance(answer, RuntimeMissingError)]
    if len(failed) == len(available):
        raise failed[0]
    found = itertools.chain.from_iterable(answer for answer in answers if isinstance(answer, list))
    fitting = [camera for camera in found if camera.uri.startswith(pinned)]
    return [camera for camera in fitting if camera.uri == pinned] or fitting


def _listed(driver: CameraDriver) -> list[ListedCamera] | RuntimeMissingError:
    """Return a driver's cameras, or why it has none to offer: one SDK that fails hides no other's cameras."""
    try:
        return driver.list_cameras()
    except RuntimeMissingError as error:
        return error


def _may_have(driver: CameraDriver, pinned: str) -> bool:
    """Whether a camera with an address that begins so can be one of this driver; no other SDK is started for it."""
    return driver.prefix.startswith(pinned) or _driver_of(pinned) is driver


def listed_address(uri: str | None, pinned: str = "") -> str:
    """Return the address of a listed camera, the first where none is asked for.

    Only listed addresses are opened: an SDK may open a file just as well, and files have to lie in the allowed folders.

    Raises
    ------
    RuntimeMissingError
        No SDK is on this machine.
    SourceLostError
        No such camera is connected, or ``pinned`` is the beginning of several.
    """
    found = [camera.uri for camera in list_cameras(pinned)]
    if pinned and uri is None and len(found) > 1:
        msg = f"TIDEGATE_CAMERA_URI {pinned} is the beginning of {len(found)} cameras: it has to name one"
        raise SourceLostError(msg)
    if not found or (uri is not None and uri not in found):
        raise SourceLostError(f"{_labels()} sees no such camera")
    return uri or found[0]


def address_in_turn(turn: int, lost: str, pinned: str = "") -> str:
    """Return where the camera of a lost address may be now: there, or at another address of its kind each turn.

    Only its own SDK is asked, and not for every turn (`engine.capture.camera_process.source.listed`). An address with a
    serial number stays the camera's.

    Raises
    ------
    RuntimeMissingError, SourceLostError
        Its SDK does not start, or sees no such camera.
    """
    driver = _driver_of(lost)
    found = [camera.uri for camera in driver.list_cameras() if camera.uri.startswith(pinned)]
    if driver.prefix:
        found = [address for address in found if address == lost]
    if not found:
        raise SourceLostError(f"{driver.label} sees no camera")
    return found[turn % len(found)]


def none_text() -> str:
    """Return the words for no connected camera."""
    return f"{_labels()} sees no camera"


def open_camera(
    uri: str | None, *, clock: Clock, use_registration: bool = False, options: CameraOptions = AS_IT_IS
) -> LiveSource:
    """Return a camera by its driver, not opened; see :meth:`engine.capture.source.CameraDriver.camera`."""
    return _driver_of(uri).camera(uri, clock=clock, use_registration=use_registration, options=options)


def registered_view(uri: str) -> RegisteredView | None:
    """Return a camera's registered view; see :meth:`engine.capture.source.CameraDriver.registered_view`."""
    return _driver_of(uri).registered_view(uri)


def warm_up_s(uri: str | None) -> float:
    """Return how long readings of a camera drift after its start [s], by its kind."""
    return _driver_of(uri).warm_up_s


def most_noise_mm(uri: str | None) -> float:
    """Return the noise of a training from which a camera is not as its kind should be [mm]."""
    return _driver_of(uri).most_noise_mm


def factory_calibration(uri: str) -> FactoryCalibration | None:
    """Return a camera's own calibration; see :meth:`engine.capture.source.CameraDriver.factory_calibration`."""
    return _driver_of(uri).factory_calibration(uri)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraKind:
    """A kind of cameras: its SDK, whether that is installed, what installs it, and the plug-in it is of, if any."""

    label: str
    is_installed: bool
    install_hint: str
    plug_in: str = ""


def kinds() -> list[CameraKind]:
    """Return every kind of cameras, installed or not."""
    return [
        CameraKind(
            label=one.label,
            is_installed=one.is_installed(),
            install_hint=one.install_hint,
            plug_in=PLUG_INS[one.prefix].label if one.prefix in PLUG_INS else "",
        )
        for one in CAMERAS
    ]


def is_player_available() -> bool:
    """Whether an SDK here plays recordings in real time."""
    return any(driver.is_player and driver.is_available() for driver in CAMERAS)


def real_time_player(path: Path, *, clock: Clock) -> LiveSource | None:
    """Return what plays a recording through an SDK in real time; None where no SDK here can."""
    return next(filter(None, (driver.player(path, clock=clock) for driver in _available())), None)


def recording_source(source: str | Path | None, *, clock: Clock, record_to: Path) -> LiveSource:
    """Return a camera, or a file played in real time, whose frames the SDK writes to an ``.oni`` file.

    Raises
    ------
    RuntimeMissingError
        No SDK here can.
    """
    made = None if source is None else maker_recording(Path(source))
    if made is not None:
        return _driver_of(made).camera(made, clock=clock, record_to=record_to)
    if source is None or not Path(source).is_file():
        return _driver_of(None if source is None else str(source)).camera(
            None if source is None else str(source), clock=clock, record_to=record_to
        )
    players = (driver.player(Path(source), clock=clock, record_to=record_to) for driver in _available())
    player = next(filter(None, players), None)
    if player is None:
        raise RuntimeMissingError(missing_text())
    return player


def maker_recording(path: Path) -> str | None:
    """Return the address of a recording that a maker's SDK has made; None for another kind of file, or none.

    Raises
    ------
    RecordingError, RuntimeMissingError
        It is of neither maker, or its SDK is not on this machine.
    """
    if path.suffix not in SUFFIXES or not path.is_file():
        return None
    with path.open("rb") as file:
        ends = file.read(ENDS_BYTES)
        file.seek(max(path.stat().st_size - ENDS_BYTES, 0))
        ends += file.read(ENDS_BYTES)
    found = [driver for mark, driver in MAKERS.items() if mark in ends]
    if not found:
        raise RecordingError(f"{path} is a recording of neither RealSense's nor Orbbec's SDK")
    if not found[0].is_installed():
        raise RuntimeMissingError(f"{found[0].label} is missing: {found[0].install_hint}")
    return f"{found[0].prefix}{FILE}{path.absolute()}"


def _available() -> list[CameraDriver]:
    return [driver for driver in CAMERAS if driver.is_available()]


def _driver_of(uri: str | None) -> CameraDriver:
    return next((driver for driver in CAMERAS if (uri or "").startswith(driver.prefix)), CAMERAS[-1])


def _labels() -> str:
    return " or ".join(driver.label for driver in CAMERAS)
