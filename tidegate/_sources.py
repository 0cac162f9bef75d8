"""Where frames come from: recordings, cameras, phantoms; and the camera's calibration."""

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from engine.calibration.camera_calibration import Calibration, load_calibration
from engine.capture import drivers
from engine.capture.recorder import record
from engine.capture.recording_source import OniFileSource
from engine.capture.source import DepthSource, ListedCamera, SourceDescription
from engine.core.clock import Clock, ManualClock, MonotonicClock
from engine.core.errors import CalibrationError, InvalidValueError, SourceEndedError, TidegateError
from engine.core.frames import RgbdFrame
from engine.core.plug_ins import CAMERAS, find_plug_ins

TIMEOUT_S = 5.0
LONGEST_S = 86_400.0
LAB = "tidegate.make_phantom needs the lab: pip install 'tidegate[lab]'"


class LabMissingError(TidegateError):
    """The lab is not installed."""


class Source:
    """A recording or a camera: a context manager that yields its frames in order, each once.

    Attributes
    ----------
    calibration
        That of its camera; None where none was given or found.
    description
        Sizes, rate and serial number; None until it is first opened.
    """

    def __init__(self, source: DepthSource, calibration: Calibration | None, clock: Clock, *, is_live: bool) -> None:
        self._source, self._clock, self._is_live = source, clock, is_live
        self.calibration = calibration
        self.description: SourceDescription | None = None
        self._is_open = False

    @property
    def is_live(self) -> bool:
        """Whether it is a camera."""
        return self._is_live

    @property
    def clock(self) -> Clock:
        """The clock that stamps its frames."""
        return self._clock

    def __enter__(self) -> Self:
        """Open it; raise SourceLostError or RecordingError where that fails."""
        if not self._is_open:
            self.description, self._is_open = self._source.open(), True
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close it."""
        self._is_open = False
        self._source.close()

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Yield every frame; a camera's until the caller stops.

        Raises
        ------
        FrameTimeoutError
            A camera gave no frame for 5 s.
        SourceLostError, RecordingError
            The camera is disconnected, or the recording is damaged from here on.
        """
        with self:
            while True:
                try:
                    yield self._source.read(TIMEOUT_S)
                except SourceEndedError:
                    return


def open_recording(path: str | Path, calibration: Calibration | str | Path | None = None) -> Source:
    """Return an ``.oni`` recording, not opened; with the ``calibration.json`` beside it where none is given.

    Raises
    ------
    CalibrationError
        The calibration cannot be used.
    """
    beside = Path(path).with_name("calibration.json")
    given = calibration if calibration is not None or not beside.is_file() else beside
    clock = ManualClock()
    return Source(OniFileSource(Path(path), clock=clock), as_calibration(given), clock, is_live=False)


def open_camera(address: str | None = None, calibration: Calibration | str | Path | None = None) -> Source:
    """Return a camera, not opened: the first one, or that at an address of `list_cameras`.

    Raises
    ------
    CalibrationError
        The calibration cannot be used.
    RuntimeMissingError, SourceLostError
        No SDK, or no such camera.
    """
    drivers.add_cameras(find_plug_ins(CAMERAS))
    uri, clock = drivers.listed_address(address), MonotonicClock()
    return Source(drivers.open_camera(uri, clock=clock), as_calibration(calibration), clock, is_live=True)


def list_cameras() -> list[ListedCamera]:
    """List the connected cameras, also those of plug-ins; raise RuntimeMissingError without any SDK."""
    drivers.add_cameras(find_plug_ins(CAMERAS))
    return drivers.list_cameras()


def as_calibration(given: Calibration | str | Path | None) -> Calibration | None:
    """Read a calibration file; a calibration, or None, stays."""
    return load_calibration(Path(given)) if isinstance(given, (str, Path)) else given


def required_calibration(source: Source, given: Calibration | str | Path | None) -> Calibration:
    """Return the calibration to measure with; raise CalibrationError where there is none."""
    found = as_calibration(given) or source.calibration
    if found is None:
        raise CalibrationError("calibration", "None", "a calibration, or a calibration.json beside the recording")
    return found


def calibrate(
    depth_pictures: str | Path,
    color_pictures: str | Path,
    *,
    columns: int,
    rows: int,
    square_mm: float,
    camera: str = "camera",
) -> Calibration:
    """Calibrate a camera by pictures of a checkerboard; pairs have the same file name in both folders.

    Parameters
    ----------
    depth_pictures, color_pictures
        Folders of infrared and colour pictures.
    columns, rows
        Inner corners of the board along both sides: squares less one.
    square_mm
        Side of a square [mm].

    Raises
    ------
    InvalidValueError
        No board, or none in the pictures.
    """
    from engine.calibration.procedures import Board, calibrate as fit, find_boards
    from engine.calibration.procedures.boards import list_pictures, match_pictures

    board = Board(columns=columns, rows=rows, square_mm=square_mm)
    folders = (("depth_pictures", depth_pictures), ("color_pictures", color_pictures))
    matched, unpaired = match_pictures(*(list_pictures(name, str(where)) for name, where in folders))
    found = find_boards(board, matched)
    if not found.pairs:
        bound = f"pictures of a board of {columns} x {rows} inner corners"
        raise CalibrationError("pictures", f"{len(matched)} pairs", bound)
    return fit(board, found, camera=camera, unpaired=unpaired).calibration


def convert(recording: str | Path, out: str | Path) -> None:
    """Write a recording of a maker's SDK (``.bag``, ``.db3``) as ``.oni``.

    Raises
    ------
    RuntimeMissingError, RecordingError
        The maker's SDK is missing, or the recording cannot be read.
    InvalidValueError
        ``out`` does not end in ``.oni``.
    """
    if Path(out).suffix != ".oni":
        raise InvalidValueError("out", str(out), "a file that ends in .oni")
    record(str(recording), Path(out), seconds=LONGEST_S, clock=MonotonicClock())


def make_phantom(
    out: str | Path,
    scenario: str = "regular",
    *,
    seconds: float = 60.0,
    volunteer: int = 1,
    seed: int = 1,
    sensor: str = "usual",
    workers: int = 1,
) -> Path:
    """Make a virtual volunteer's ``recording.oni``, ``calibration.json`` and ``truth.npz``; return the folder.

    Parameters
    ----------
    scenario
        ``regular``, ``irregular``, ``isovolume``, ``dibh``, ``drift``, ``shift``, ``occlusion`` or ``events``.
    volunteer
        1 to 10.
    workers
        Number of processes; a script that gives more than 1 needs ``if __name__ == "__main__":``.

    Raises
    ------
    LabMissingError
        The lab is not installed.
    InvalidValueError
        A value is out of its bounds.
    """
    try:
        from lab.phantom.recording import make_volunteer
    except ImportError as error:
        raise LabMissingError(LAB) from error
    folder = Path(out)
    make_volunteer(
        scenario, volunteer=volunteer, seconds=seconds, seed=seed, sensor=sensor, out=folder, workers=workers
    )
    return folder
