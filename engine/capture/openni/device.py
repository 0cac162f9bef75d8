"""One opened OpenNI2 device, or file, with its depth and its colour stream; every call of the runtime is made here.

For one thread at a time, but for :meth:`OpenNiDevice.lost` and :attr:`OpenNiDevice.is_over`, which events set from the
runtime's own threads.

One frame copied out of the runtime's memory, or refused: an implausible head makes the picture unusable.

The size of the copy is bounded by the size the stream was started with, never by the frame's own head: a wrong head
would otherwise cause a read beyond the frame's memory.
"""

import ctypes
import os
import threading
import time
from collections.abc import Callable, Sequence
from ctypes import byref
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engine.capture.openni import c_api as c
from engine.core.errors import RecordingError, SourceLostError
from engine.core.frames import ColorImage, DepthImage

DEPTH, COLOR = 0, 1
SENSOR = (c.SENSOR_DEPTH, c.SENSOR_COLOR)
FORMATS = ((c.PIXEL_DEPTH_1_MM, c.PIXEL_DEPTH_100_UM), (c.PIXEL_RGB888,))
LATEST_US = 2**53
"""Nearly three centuries: no camera has run for longer, and a database keeps no larger time exactly."""

_BYTES_A_PIXEL = (2, 3)
_KIND = ("depth", "colour")
_REST_S = 0.1
_STATE_WORDS = {1: "reports an error", 2: "is not ready"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeviceFrame:
    """A frame copied out of the runtime's memory; ``picture`` is uint16 (H, W) in mm or RGB uint8 (H, W, 3)."""

    stream: int
    frame_index: int
    timestamp_us: int
    picture: DepthImage | ColorImage


def copied(stream: int, frame: c.Frame, size_px: tuple[int, int]) -> DeviceFrame | None:
    """Return a frame of a stream that delivers ``size_px`` (width, height); None where its head cannot be true."""
    width, height = size_px
    stride = width * _BYTES_A_PIXEL[stream]
    needed = stride * height
    is_sound = (
        frame.sensor_type == SENSOR[stream]
        and frame.video_mode.pixel_format in FORMATS[stream]
        and (frame.width, frame.height, frame.stride) == (width, height, stride)
        and frame.data_size >= needed
        and frame.data is not None
        and 0 <= frame.timestamp_us <= LATEST_US
        and frame.frame_index >= 0
    )
    if not is_sound:
        return None
    raw = np.frombuffer(ctypes.string_at(frame.data, needed), np.uint8)
    picture: DepthImage | ColorImage
    if stream == COLOR:
        picture = raw.reshape(height, width, 3)
    else:
        picture = raw.view(np.uint16).reshape(height, width)
        if frame.video_mode.pixel_format == c.PIXEL_DEPTH_100_UM:
            picture = (picture + np.uint16(5)) // np.uint16(10)
    return DeviceFrame(
        stream=stream, frame_index=frame.frame_index, timestamp_us=int(frame.timestamp_us), picture=picture
    )


class OpenNiDevice:
    """An open device; raise SourceLostError or RecordingError when it cannot be."""

    def __init__(self, uri: str, *, is_file: bool) -> None:
        self._runtime = c.runtime()
        self._is_file = is_file
        self._streams = (c.Handle * 2)()
        self._handle = c.Handle()
        self._lost: str | None = None
        self._sizes_px = ((0, 0), (0, 0))
        self.is_over = False
        if self._runtime.oniDeviceOpen(os.fsencode(uri), byref(self._handle)) != c.STATUS_OK:
            msg = f"{uri} cannot be opened by OpenNI2: {c.last_error()}"
            raise (RecordingError if is_file else SourceLostError)(msg)
        info = c.DeviceInfo()
        self._runtime.oniDeviceGetInfo(self._handle, byref(info))
        self.uri = bytes(info.uri)
        self.name = info.name.decode(errors="replace") or "OpenNI2 device"
        _listeners.add(self)

    def lost(self) -> str | None:
        """Return why the device is gone, if it is."""
        return self._lost

    def note_state(self, state: int) -> None:
        """Take in a change of the device's state; called from the runtime's threads."""
        if state == c.STATE_EOF:
            self.is_over = True
        elif state in _STATE_WORDS:
            self._lost = f"{self.name} {_STATE_WORDS[state]}"

    def note_disconnected(self) -> None:
        """Take in that the device was unplugged; called from the runtime's threads."""
        self._lost = f"{self.name} was disconnected"

    def create_streams(self, sizes_px: Sequence[tuple[int, int]], fps: int, *, use_registration: bool) -> None:
        """Create both streams, not mirrored, with the asked-for mode where the device is live."""
        self._set_registration(is_on=use_registration)
        for stream in (DEPTH, COLOR):
            handle = c.Handle()
            if self._runtime.oniDeviceCreateStream(self._handle, SENSOR[stream], byref(handle)) != c.STATUS_OK:
                msg = f"{self.name} has no {_KIND[stream]} stream: {c.last_error()}"
                raise (RecordingError if self._is_file else SourceLostError)(msg)
            self._streams[stream] = handle.value
            if not self._is_file:
                self._set_mode(stream, sizes_px[stream], fps)
                self._unmirror(handle, _KIND[stream])

    def _unmirror(self, handle: c.Handle, kind: str) -> None:
        """Switch mirroring off; a picture that stays mirrored would take the patient's right side for the left."""
        self._set(self._runtime.oniStreamSetProperty, handle, c.STREAM_MIRRORING, ctypes.c_int(0))
        is_on, size = ctypes.c_int(0), ctypes.c_int(ctypes.sizeof(ctypes.c_int))
        status = self._runtime.oniStreamGetProperty(handle, c.STREAM_MIRRORING, byref(is_on), byref(size))
        if status == c.STATUS_OK and is_on.value:
            msg = f"{self.name} does not stop mirroring its {kind} pictures"
            raise SourceLostError(msg)

    def set_playback(self, *, speed: float) -> None:
        """Play a file once, at ``speed``."""
        self._set(self._runtime.oniDeviceSetProperty, self._handle, c.DEVICE_PLAYBACK_REPEAT, ctypes.c_int(0))
        self._set(self._runtime.oniDeviceSetProperty, self._handle, c.DEVICE_PLAYBACK_SPEED, ctypes.c_float(speed))

    def start(self) -> None:
        """Start depth, then colour: should a file begin to play between the two, no depth frame is lost."""
        modes = [self.video_mode(stream) for stream in (DEPTH, COLOR)]
        self._sizes_px = ((modes[DEPTH].width, modes[DEPTH].height), (modes[COLOR].width, modes[COLOR].height))
        for stream in (DEPTH, COLOR):
            if self._runtime.oniStreamStart(self._streams[stream]) != c.STATUS_OK:
                msg = f"{self.name} does not start its {_KIND[stream]} stream: {c.last_error()}"
                raise SourceLostError(msg)

    def video_mode(self, stream: int) -> c.VideoMode:
        """Read a stream's present mode."""
        mode = c.VideoMode()
        size = ctypes.c_int(ctypes.sizeof(mode))
        status = self._runtime.oniStreamGetProperty(
            self._streams[stream], c.STREAM_VIDEO_MODE, byref(mode), byref(size)
        )
        if status != c.STATUS_OK or mode.pixel_format not in FORMATS[stream]:
            msg = f"{self.name} gives {_KIND[stream]} in pixel format {mode.pixel_format}, which cannot be read"
            raise (RecordingError if self._is_file else SourceLostError)(msg)
        return mode

    def wait(self, timeout_ms: int) -> DeviceFrame | None:
        """Return the next frame of either stream, copied, or None if none came in time.

        Only from a lasting thread; see :mod:`engine.capture.openni.c_api`.
        """
        ready = ctypes.c_int(-1)
        if self._runtime.oniWaitForAnyStream(self._streams, 2, byref(ready), timeout_ms) != c.STATUS_OK:
            return None
        pointer = ctypes.POINTER(c.Frame)()
        if self._runtime.oniStreamReadFrame(self._streams[ready.value], byref(pointer)) != c.STATUS_OK:
            return None
        try:
            return copied(ready.value, pointer.contents, self._sizes_px[ready.value])
        finally:
            self._runtime.oniFrameRelease(pointer)

    def is_silent(self, timeout_ms: int) -> bool:
        """Whether neither stream had or got a frame for so long; waits until then, or until there is a frame.

        Told by the runtime's status, not by a clock: a thread that slept longer than it should has waited for nothing.
        Only from a lasting thread; see :mod:`engine.capture.openni.c_api`.
        """
        ready = ctypes.c_int(-1)
        status: int = self._runtime.oniWaitForAnyStream(self._streams, 2, byref(ready), timeout_ms)
        return status == c.STATUS_TIME_OUT

    def start_recorder(self, path: Path) -> c.Handle:
        """Attach the runtime's recorder to both streams, before they start."""
        recorder = c.Handle()
        if self._runtime.oniCreateRecorder(os.fsencode(path), byref(recorder)) != c.STATUS_OK:
            msg = f"{path} cannot be written by OpenNI2: {c.last_error()}"
            raise RecordingError(msg)
        for stream in (DEPTH, COLOR):
            is_lossy = int(stream == COLOR)
            self._runtime.oniRecorderAttachStream(recorder, self._streams[stream], is_lossy)
        if self._runtime.oniRecorderStart(recorder) != c.STATUS_OK:
            msg = f"{path}: the recorder of OpenNI2 does not start: {c.last_error()}"
            raise RecordingError(msg)
        return recorder

    def stop(self) -> None:
        """Stop both streams and wait until the runtime's threads have noticed.

        Its file player walks its list of streams without a lock, all the time while one of them is started and after
        the file's end; a stream destroyed meanwhile, or a recorder with a frame on its way, crashes the process.
        """
        started = [stream for stream in self._streams if stream]
        for stream in started:
            self._runtime.oniStreamStop(stream)
        if started:
            time.sleep(_REST_S)

    def finish_recorder(self, recorder: c.Handle) -> None:
        """Finish the recorder's file, after :meth:`stop`; returns when its last byte is written."""
        self._runtime.oniRecorderStop(recorder)
        self._runtime.oniRecorderDestroy(byref(recorder))

    def close(self) -> None:
        """Destroy streams and device, after :meth:`stop`; safe to call twice."""
        _listeners.remove(self)
        for stream in (DEPTH, COLOR):
            if self._streams[stream]:
                self._runtime.oniStreamDestroy(self._streams[stream])
                self._streams[stream] = None
        if self._handle:
            self._runtime.oniDeviceClose(self._handle)
            self._handle = c.Handle()

    def can_register(self) -> bool:
        """Whether the device can move depth into the colour camera's view; a file cannot."""
        mode = c.REGISTRATION_DEPTH_TO_COLOR
        return bool(self._runtime.oniDeviceIsImageRegistrationModeSupported(self._handle, mode))

    def serial(self) -> str:
        """Return the device's serial number; empty where it has none."""
        text = ctypes.create_string_buffer(c.MAX_TEXT)
        size = ctypes.c_int(c.MAX_TEXT)
        status = self._runtime.oniDeviceGetProperty(self._handle, c.DEVICE_SERIAL_NUMBER, text, byref(size))
        return text.value.decode(errors="replace") if status == c.STATUS_OK else ""

    def color_view_rad(self) -> tuple[float, float]:
        """Return the colour camera's horizontal and vertical field of view [rad], before the streams are made."""
        handle = c.Handle()
        if self._runtime.oniDeviceCreateStream(self._handle, c.SENSOR_COLOR, byref(handle)) != c.STATUS_OK:
            msg = f"{self.name} has no colour stream: {c.last_error()}"
            raise SourceLostError(msg)
        try:
            return self._angle(handle, c.STREAM_HORIZONTAL_FOV), self._angle(handle, c.STREAM_VERTICAL_FOV)
        finally:
            self._runtime.oniStreamDestroy(handle)

    def _angle(self, stream: c.Handle, name: int) -> float:
        angle, size = ctypes.c_float(0.0), ctypes.c_int(ctypes.sizeof(ctypes.c_float))
        if self._runtime.oniStreamGetProperty(stream, name, byref(angle), byref(size)) != c.STATUS_OK:
            msg = f"{self.name} does not report its field of view: {c.last_error()}"
            raise SourceLostError(msg)
        return float(angle.value)

    def _set_registration(self, *, is_on: bool) -> None:
        """Switch registration; where it is asked for and does not come, depth would lie beside colour unseen."""
        if is_on and not self.can_register():
            kind = "a recording" if self._is_file else self.name
            msg = f"{kind} cannot register depth to colour: a calibration is needed"
            raise (RecordingError if self._is_file else SourceLostError)(msg)
        if not self.can_register():
            return
        mode = ctypes.c_int(c.REGISTRATION_DEPTH_TO_COLOR if is_on else c.REGISTRATION_OFF)
        status = self._runtime.oniDeviceSetProperty(
            self._handle, c.DEVICE_IMAGE_REGISTRATION, byref(mode), ctypes.sizeof(mode)
        )
        if status != c.STATUS_OK:
            msg = f"{self.name} does not switch its registration {'on' if is_on else 'off'}: {c.last_error()}"
            raise SourceLostError(msg)

    def _set_mode(self, stream: int, size_px: tuple[int, int], fps: int) -> None:
        sensor = self._runtime.oniDeviceGetSensorInfo(self._handle, SENSOR[stream])
        modes = [sensor.contents.modes[i] for i in range(sensor.contents.mode_count)] if sensor else []
        for pixel_format in FORMATS[stream]:
            for mode in modes:
                if (mode.width, mode.height, mode.fps, mode.pixel_format) == (*size_px, fps, pixel_format):
                    handle = self._streams[stream]
                    self._set(self._runtime.oniStreamSetProperty, handle, c.STREAM_VIDEO_MODE, mode)
                    return
        offered = ", ".join(sorted({f"{mode.width}x{mode.height}@{mode.fps}" for mode in modes})) or "none"
        msg = f"{self.name} has no {_KIND[stream]} mode {size_px[0]}x{size_px[1]}@{fps}; it offers {offered}"
        raise SourceLostError(msg)

    @staticmethod
    def _set(call: Callable[..., Any], handle: object, name: int, value: "ctypes._CData") -> None:
        """Set a property; a device without it is unchanged, which the frames' heads show."""
        call(handle, name, byref(value), ctypes.sizeof(value))


class _Listeners:
    """Hands the runtime's device events to the open devices; registered once a process."""

    def __init__(self) -> None:
        self._devices: list[OpenNiDevice] = []
        self._lock = threading.Lock()
        self._callbacks: c.DeviceCallbacks | None = None

    def add(self, device: OpenNiDevice) -> None:
        with self._lock:
            self._devices = [*self._devices, device]
            if self._callbacks is None:
                self._register()

    def remove(self, device: OpenNiDevice) -> None:
        with self._lock:
            self._devices = [other for other in self._devices if other is not device]

    def _register(self) -> None:
        # Kept for the life of the process: the runtime calls these from its own threads.
        self._callbacks = c.DeviceCallbacks(
            c.DeviceCallback(lambda _info, _cookie: None),
            c.DeviceCallback(lambda info, _cookie: self._disconnected(info)),
            c.StateCallback(lambda info, state, _cookie: self._changed(info, state)),
        )
        handle = c.Handle()
        c.runtime().oniRegisterDeviceCallbacks(byref(self._callbacks), None, byref(handle))

    # No lock below: the runtime may call while a thread that holds it waits for the runtime.
    def _disconnected(self, info: "ctypes._Pointer[c.DeviceInfo]") -> None:
        for device in self._devices:
            if device.uri == info.contents.uri:
                device.note_disconnected()

    def _changed(self, info: "ctypes._Pointer[c.DeviceInfo]", state: int) -> None:
        for device in self._devices:
            if device.uri == info.contents.uri:
                device.note_state(state)


_listeners = _Listeners()
