"""Live devices, and ``.oni`` files in real time, through the OpenNI2 runtime.

The runtime keeps one frame a stream and overwrites it, so a thread of the source reads frames as they come and stamps
them; the engine thread takes them from there. A short stall of the engine then loses no frame, a long one shows as
``missed_frames``, and a call that hangs in a driver blocks no other thread.

Pairing. For a *file*, the colour frame nearest in time, as :class:`engine.capture.recording_source.OniFileSource` has
it; the source waits where a later one may be nearer, so that both deliver the same frames. For a *live* device, the
nearest colour frame already received: the newest at or before the depth frame, but for jitter.
"""

import ctypes
import time
from ctypes import byref
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from engine.capture.oni.reader import describe, missed_between
from engine.capture.oni.records import RecordType, count_records
from engine.capture.openni import c_api as c
from engine.capture.openni.c_api import run_on_lasting_thread
from engine.capture.openni.device import COLOR, DEPTH, OpenNiDevice
from engine.capture.openni.pump import CapturePump
from engine.capture.source import ListedCamera, SourceDescription
from engine.core.clock import Clock
from engine.core.errors import RecordingError, RuntimeMissingError, SourceLostError
from engine.core.frames import ColorImage, DepthImage, RgbdFrame

if TYPE_CHECKING:
    import threading

_US_PER_S = 1_000_000
_RECORDER_START_S = 5.0
# A moment without a frame, as a share of the period, that shows that none waits in the driver. The longest pause of two
# streams is half a period or more, and a driver hands a frame over within a few milliseconds.
_SILENT_SHARE = 0.25
# A colour frame this much of a period before the depth frame, or less, is the nearest even if the next one is early.
_SURELY_NEAREST = 0.375


def runtime_available() -> bool:
    """Whether the OpenNI2 runtime is on this machine and starts."""
    try:
        c.runtime()
    except RuntimeMissingError:
        return False
    return True


def list_devices() -> list[ListedCamera]:
    """List the connected devices; raise RuntimeMissingError without the runtime."""
    runtime = c.runtime()
    infos = ctypes.POINTER(c.DeviceInfo)()
    count = ctypes.c_int(0)
    if runtime.oniGetDeviceList(byref(infos), byref(count)) != c.STATUS_OK:
        return []
    try:
        devices = [
            ListedCamera(
                uri=infos[i].uri.decode(errors="replace"),
                vendor=infos[i].vendor.decode(errors="replace"),
                name=infos[i].name.decode(errors="replace"),
            )
            for i in range(count.value)
        ]
        # A file that was played once stays in the runtime's list.
        return [device for device in devices if _file_of(device.uri) is None]
    finally:
        runtime.oniReleaseDeviceList(infos)


class OpenNiSource:
    """A DepthSource over the OpenNI2 runtime.

    Parameters
    ----------
    uri
        A device's address, an ``.oni`` file, or None for the first device.
    clock
        Stamps ``received_ns``, from the source's own thread.
    depth_size, color_size, fps
        The mode requested from a live device; a file has its own.
    use_device_registration
        Let the device move depth into the colour camera's view; off, because our calibration does that.
    record_to
        Let the runtime's recorder write the frames to this file; see :mod:`engine.capture.recorder`.
    """

    def __init__(
        self,
        uri: str | Path | None,
        *,
        clock: Clock,
        depth_size: tuple[int, int] = (640, 480),
        color_size: tuple[int, int] = (640, 480),
        fps: int = 30,
        use_device_registration: bool = False,
        record_to: Path | None = None,
    ) -> None:
        self._path = _file_of(uri)
        self._uri = str(uri) if self._path is None and uri is not None else None
        if self._path is not None:
            self._uri = str(self._path.absolute())
        self._clock = clock
        self._sizes_px = (depth_size, color_size)
        self._fps = fps
        self._use_registration = use_device_registration
        self._record_to = record_to
        self._is_mirrored = (False, False)
        self._last_color_us: int | None = None
        self._device: OpenNiDevice | None = None
        self._recorder: c.Handle | None = None
        self._pump: CapturePump | None = None
        self._freed: threading.Event | None = None
        self._period_us = _US_PER_S / fps
        self._last: tuple[int, int] | None = None
        self._index = 0

    def open(self) -> SourceDescription:
        """Open the device and start its streams.

        Raises
        ------
        RuntimeMissingError
            No OpenNI2 runtime here.
        SourceLostError
            No such device, or one without the requested mode.
        RecordingError
            The file is damaged: the runtime crashes on some, so it is given intact ones only.
        """
        self.close()
        c.runtime()
        if self._path is not None:
            stored = describe(self._path)
            stored.raise_damage()
            color = stored.color
            self._serial = stored.serial
            self._is_mirrored = (stored.depth.is_mirrored, color is not None and color.is_mirrored)
            self._last_color_us = None if color is None else color.last_timestamp_us
        self._device = OpenNiDevice(
            self._uri if self._uri is not None else _first_uri(), is_file=self._path is not None
        )
        try:
            return self._start(self._device)
        except BaseException:
            self.close()
            raise

    def _start(self, device: OpenNiDevice) -> SourceDescription:
        device.create_streams(self._sizes_px, self._fps, use_registration=self._use_registration)
        if self._path is not None:
            device.set_playback(speed=1.0)
        depth, color = device.video_mode(DEPTH), device.video_mode(COLOR)
        self._period_us = _US_PER_S / max(depth.fps, 1)
        self._last, self._index = None, 0
        if self._record_to is not None:
            self._recorder = device.start_recorder(self._record_to)
            _await_recorder(self._record_to)
        device.start()
        silence_ms = max(int(self._period_us * _SILENT_SHARE / 1_000), 1) if self._path is None else None
        self._pump = CapturePump(device, self._clock, silence_ms=silence_ms, last_color_us=self._last_color_us)
        self._pump.start()
        return SourceDescription(
            kind="openni_file" if self._path is not None else "openni",
            name=self._path.name if self._path is not None else device.name,
            depth_size=(depth.width, depth.height),
            color_size=(color.width, color.height),
            fps=float(depth.fps),
            is_live=self._path is None,
            serial=device.serial() if self._path is None else self._serial,
        )

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame; see :class:`engine.capture.source.DepthSource`."""
        if self._pump is None:
            msg = "the device is not open"
            raise SourceLostError(msg)
        margin_us = None if self._path is None else self._period_us * _SURELY_NEAREST
        depth, color = self._pump.take(timeout_s, margin_us)
        now = depth.frame.timestamp_us, depth.frame.frame_index
        if self._last is not None:
            missed = missed_between(self._last, now, self._period_us)
        else:
            missed = now[1] - 1 if self._path is not None else 0
        self._last = now
        frame = RgbdFrame(
            index=self._index,
            device_index=depth.frame.frame_index,
            missed_frames=max(missed, 0),
            timestamp_us=depth.frame.timestamp_us,
            color_timestamp_us=color.frame.timestamp_us,
            received_ns=depth.received_ns,
            queue_empty_ns=depth.queue_empty_ns,
            depth_mm=cast("DepthImage", _turned(depth.frame.picture, is_mirrored=self._is_mirrored[DEPTH])),
            color=cast("ColorImage", _turned(color.frame.picture, is_mirrored=self._is_mirrored[COLOR])),
        )
        self._index += 1
        return frame

    def close(self) -> None:
        """Stop streams and recorder, and release the device; safe to call twice, and after a failure.

        Where a call hangs in the driver, the device is released when it returns: freed earlier, it would crash.
        """
        pump, device, recorder = self._pump, self._device, self._recorder
        self._pump = self._device = self._recorder = None
        if device is None:
            return
        if pump is None or pump.stop():
            _release(device, recorder)
            return

        def release_later() -> None:
            pump.await_end()
            _release(device, recorder)

        self._freed = run_on_lasting_thread(release_later)

    @property
    def is_free(self) -> bool:
        """Whether no call hangs in the driver any more, after :meth:`close`."""
        return self._freed is None or self._freed.is_set()


def _release(device: OpenNiDevice, recorder: c.Handle | None) -> None:
    device.stop()
    if recorder is not None:
        device.finish_recorder(recorder)
    device.close()


def _await_recorder(path: Path) -> None:
    """Wait until the recorder's own thread takes frames; earlier frames would be missing in the recording."""
    deadline_s = time.monotonic() + _RECORDER_START_S
    while time.monotonic() < deadline_s:
        if count_records(path, RecordType.DATA_BEGIN) == 2:
            return
        time.sleep(0.01)
    msg = f"{path}: the recorder of OpenNI2 does not start writing"
    raise RecordingError(msg)


def _first_uri() -> str:
    devices = list_devices()
    if not devices:
        msg = "no OpenNI2 device is connected"
        raise SourceLostError(msg)
    return devices[0].uri


def _file_of(uri: str | Path | None) -> Path | None:
    if uri is None or (isinstance(uri, str) and not uri.endswith(".oni") and not Path(uri).is_file()):
        return None
    return Path(uri)


def _turned(picture: DepthImage | ColorImage, *, is_mirrored: bool) -> DepthImage | ColorImage:
    """Return a picture of a file as the camera saw it: a live camera's mirroring is switched off."""
    return cast("DepthImage | ColorImage", np.ascontiguousarray(picture[:, ::-1])) if is_mirrored else picture
