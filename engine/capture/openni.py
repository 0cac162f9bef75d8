"""Live devices, and ``.oni`` files in real time, through the OpenNI2 runtime.

The runtime keeps one frame a stream and overwrites it, so a thread of the source's own takes frames out as they come
and stamps them; the engine's thread picks them up. A short stall of the engine then costs nothing, a long one shows as
``missed_frames``, and a call that hangs in a driver hangs a thread that nobody waits for.

Pairing. A *file* gets the colour frame nearest in time, as :class:`engine.capture.oni_file.OniFileSource` does, and
waits for it where a later one may be nearer, so that both deliver the same frames. A *live* device never waits: it gets
the nearest of the colour frames that are already in hand: the newest at or before the depth frame, but for jitter.
"""

import ctypes
import time
from ctypes import byref
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from engine.calibration import Calibration, nominal_calibration
from engine.capture import _openni_c as c
from engine.capture._lasting_threads import run_on_lasting_thread
from engine.capture._openni_device import OpenNiDevice
from engine.capture._openni_frame import COLOR, DEPTH
from engine.capture._openni_pump import CapturePump
from engine.capture.source import SourceDescription
from engine.clock import Clock
from engine.errors import RecordingError, RuntimeMissingError, SourceLostError
from engine.frames import ColorImage, DepthImage, RgbdFrame
from engine.oni.layout import RecordType
from engine.oni.reader import describe, missed_between
from engine.oni.records import count_records

if TYPE_CHECKING:
    import threading

REGISTERED_SIZE_PX = (640, 480)
_US_PER_S = 1_000_000
_RECORDER_START_S = 5.0
# A colour frame this much of a period before the depth frame, or less, is the nearest even if the next one is early.
_SURELY_NEAREST = 0.375


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedDevice:
    """A device that is plugged in."""

    uri: str
    vendor: str
    name: str


def runtime_available() -> bool:
    """Whether the OpenNI2 runtime is on this machine and starts."""
    try:
        c.runtime()
    except RuntimeMissingError:
        return False
    return True


def runtime_installed() -> bool:
    """Whether the OpenNI2 runtime is on this machine; does not start it, and does not say that it would start."""
    return c.library_path() is not None


def list_devices() -> list[ListedDevice]:
    """List the devices plugged in now; raise RuntimeMissingError without the runtime."""
    runtime = c.runtime()
    infos = ctypes.POINTER(c.DeviceInfo)()
    count = ctypes.c_int(0)
    if runtime.oniGetDeviceList(byref(infos), byref(count)) != c.STATUS_OK:
        return []
    try:
        devices = [
            ListedDevice(
                uri=infos[i].uri.decode(errors="replace"),
                vendor=infos[i].vendor.decode(errors="replace"),
                name=infos[i].name.decode(errors="replace"),
            )
            for i in range(count.value)
        ]
        # A file that was played once stays in the runtime's list for ever.
        return [device for device in devices if _file_of(device.uri) is None]
    finally:
        runtime.oniReleaseDeviceList(infos)


def registered_calibration(uri: str) -> Calibration | None:
    """Return the nominal calibration of a live device that registers depth to colour itself; None if it does not.

    Not for a device that a source has open: they would share it.

    Raises
    ------
    RuntimeMissingError, SourceLostError
        No runtime, or no such device.
    CalibrationError
        The device tells a field of view that cannot be.
    """
    c.runtime()
    device = OpenNiDevice(uri, is_file=False)
    try:
        if not device.can_register():
            return None
        return nominal_calibration(device.name, size_px=REGISTERED_SIZE_PX, field_of_view_rad=device.color_view_rad())
    finally:
        device.close()


class OpenNiSource:
    """A DepthSource over the OpenNI2 runtime; see the module for pairing.

    Parameters
    ----------
    uri
        A device's address, an ``.oni`` file, or None for the first device there is.
    clock
        Stamps ``received_ns``, from the source's own thread.
    depth_size, color_size, fps
        The mode asked of a live device; a file has its own.
    use_device_registration
        Let the device move depth into the colour camera's view; off, because our calibration does that.
    record_to
        Let the runtime's recorder write what comes to this file; see :mod:`engine.capture.recorder`.
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
            No such device, or one that cannot do what is asked.
        RecordingError
            A file that is no whole recording: the runtime crashes on some, so it only gets sound ones.
        """
        self.close()
        c.runtime()
        if self._path is not None:
            describe(self._path).raise_damage()
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
        self._pump = CapturePump(device, self._clock)
        self._pump.start()
        return SourceDescription(
            kind="openni_file" if self._path is not None else "openni",
            name=self._path.name if self._path is not None else device.name,
            depth_size=(depth.width, depth.height),
            color_size=(color.width, color.height),
            fps=float(depth.fps),
            is_live=self._path is None,
            serial=device.serial() if self._path is None else "",
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
            depth_mm=cast("DepthImage", depth.frame.picture),
            color=cast("ColorImage", color.frame.picture),
        )
        self._index += 1
        return frame

    def close(self) -> None:
        """Stop streams and recorder, and let go of the device; safe to call twice, and after a failure.

        Where a call hangs in the driver, the device is let go of when that comes back: freed before, it would crash.
        """
        pump, device, recorder = self._pump, self._device, self._recorder
        self._pump = self._device = self._recorder = None
        if device is None:
            return
        if pump is None or pump.stop():
            _let_go(device, recorder)
            return

        def let_go_later() -> None:
            pump.await_end()
            _let_go(device, recorder)

        self._freed = run_on_lasting_thread(let_go_later)

    @property
    def is_free(self) -> bool:
        """Whether nothing of it hangs in the driver any more, after :meth:`close`."""
        return self._freed is None or self._freed.is_set()


def _let_go(device: OpenNiDevice, recorder: c.Handle | None) -> None:
    device.stop()
    if recorder is not None:
        device.finish_recorder(recorder)
    device.close()


def _await_recorder(path: Path) -> None:
    """Wait until the recorder's own thread takes frames; what comes before is lost to the recording."""
    deadline_s = time.monotonic() + _RECORDER_START_S
    while time.monotonic() < deadline_s:
        if count_records(path, RecordType.DATA_BEGIN) == 2:
            return
        time.sleep(0.01)
    msg = f"{path}: the recorder of OpenNI2 does not begin to write"
    raise RecordingError(msg)


def _first_uri() -> str:
    devices = list_devices()
    if not devices:
        msg = "no OpenNI2 device is plugged in"
        raise SourceLostError(msg)
    return devices[0].uri


def _file_of(uri: str | Path | None) -> Path | None:
    if uri is None or (isinstance(uri, str) and not uri.endswith(".oni") and not Path(uri).is_file()):
        return None
    return Path(uri)
