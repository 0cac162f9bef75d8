"""Record a camera, or a file played in real time, with its SDK's own recorder, or with ours where it has none.

The recording has a temporary name until it is complete: the SDK writes its seek tables and frame counts last, and a
file without them is cut. It also starts each stream's time at zero, so the offset between depth and colour, up to a
period, is lost in the recording.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from engine.capture import drivers
from engine.capture.oni.reader import RecordingDescription, describe
from engine.capture.oni.records import finish
from engine.capture.source import LiveSource
from engine.core.clock import Clock
from engine.core.errors import FrameTimeoutError, RecordingError, SourceEndedError, SourceLostError
from engine.core.plug_ins import CAMERAS, find_plug_ins

_READ_TIMEOUT_S = 1.0
_MAX_SILENCE_S = 5.0
_US_PER_S = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingProgress:
    """Progress of a recording, by the device's clock."""

    seconds: float
    frames: int
    missed_frames: int


def record(
    source: str | Path | None,
    out: Path,
    *,
    seconds: float,
    clock: Clock,
    on_progress: Callable[[RecordingProgress], None] = lambda _progress: None,
    is_stop_requested: Callable[[], bool] = lambda: False,
) -> RecordingDescription:
    """Record ``seconds`` of ``source`` to ``out``; less if a file ends before or a stop is requested.

    Parameters
    ----------
    source
        A device's address, an ``.oni`` file, or None for the first device.
    out
        The recording to make; replaced only by a complete one.

    Raises
    ------
    RuntimeMissingError, SourceLostError, RecordingError
        Nothing could be recorded. If the device is lost, the frames before that are kept.
    """
    out = Path(out)
    part = out.with_name(f".{out.stem}.part.oni")
    if not out.parent.is_dir():
        msg = f"{out.parent} is no folder to record to"
        raise RecordingError(msg)
    drivers.add_cameras(find_plug_ins(CAMERAS))
    camera = drivers.recording_source(source, clock=clock, record_to=part)
    try:
        try:
            serial = camera.open().serial
            lost = _follow(camera, seconds, on_progress, is_stop_requested)
        finally:
            camera.close()  # finishes the file
        description = describe(part)
        if lost is not None and description.depth.frames == 0:
            raise lost
        description.raise_damage()
        finish(part, serial)
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    if lost is not None:
        raise lost
    return describe(out)


def _follow(
    camera: LiveSource,
    seconds: float,
    on_progress: Callable[[RecordingProgress], None],
    is_stop_requested: Callable[[], bool],
) -> SourceLostError | None:
    """Read until enough is recorded; return the error that ended it early, if any."""
    first_us: int | None = None
    missed_frames, silence_s, elapsed_s = 0, 0.0, 0.0
    while elapsed_s < seconds and not is_stop_requested():
        try:
            frame = camera.read(_READ_TIMEOUT_S)
        except FrameTimeoutError:
            silence_s += _READ_TIMEOUT_S
            if silence_s >= _MAX_SILENCE_S:
                return SourceLostError(f"no frame for {_MAX_SILENCE_S:g} s")
            continue
        except SourceEndedError:
            return None
        except SourceLostError as error:
            return error
        silence_s = 0.0
        first_us = frame.timestamp_us if first_us is None else first_us
        elapsed_s = (frame.timestamp_us - first_us) / _US_PER_S
        missed_frames += frame.missed_frames
        on_progress(RecordingProgress(seconds=elapsed_s, frames=frame.index + 1, missed_frames=missed_frames))
    return None
