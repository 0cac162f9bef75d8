"""Orbbec cameras in the camera's process: the only module that imports ``pyorbbecsdk``.

Depth and colour are those nearest to 640 x 480 at 30 frames/s. Times are the device's own; a device whose clock stands
at 0 until it is synchronised is waited for, and refused in the end. Colour that comes compressed is decoded here.
"""

import contextlib
import io
import queue
import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

# The SDK prints while it is imported; what is printed here is read by the engine.
with contextlib.redirect_stdout(io.StringIO()):
    import pyorbbecsdk as ob

from engine.capture.camera_process.lens import fitted, grid_px, with_distortion
from engine.capture.camera_process.native import (
    FILE,
    FIRST_FRAME_S,
    FPS,
    SETTLE_S,
    SIZE_PX,
    DeviceClock,
    NativeFrame,
    in_mm,
)
from engine.capture.camera_process.pairing import RecentColors
from engine.capture.source import CameraOptions, FactoryCalibration, ListedCamera, SourceDescription
from engine.core.errors import SourceEndedError, SourceLostError
from engine.core.frames import ColorImage, DepthImage
from engine.core.geometry import Intrinsics, RigidTransform

PREFIX = "orbbec:"
LONGEST_US = 2**53
QUEUED = 32
SENSORS = (ob.OBSensorType.DEPTH_SENSOR, ob.OBSensorType.COLOR_SENSOR)
FORMATS = ((ob.OBFormat.Y16, ob.OBFormat.Z16), (ob.OBFormat.RGB, ob.OBFormat.BGR, ob.OBFormat.MJPG))
DEPTH, COLOR = 0, 1

ob.Context.set_logger_level(ob.OBLogLevel.NONE)


def list_cameras() -> list[ListedCamera]:
    """List the connected cameras."""
    devices = ob.Context().query_devices()
    return [
        ListedCamera(
            uri=f"{PREFIX}{devices.get_device_serial_number_by_index(i)}",
            vendor="Orbbec",
            name=devices.get_device_name_by_index(i).removeprefix("Orbbec "),
        )
        for i in range(devices.get_count())
    ]


def camera(serial: str, options: CameraOptions) -> "OrbbecCamera":
    """Return the camera with a serial number, not opened."""
    return OrbbecCamera(serial, options)


def factory_calibration(serial: str) -> FactoryCalibration:
    """Return the calibration that a camera has from its maker; raise SourceLostError without the camera."""
    _, device = _device(serial)
    depth, color = (_profile(device, stream) for stream in (DEPTH, COLOR))
    pose = depth.get_extrinsic_to(color)
    return FactoryCalibration(
        camera=device.get_device_info().get_name(),
        serial=device.get_device_info().get_serial_number(),
        depth=_intrinsics(depth),
        color=_intrinsics(color),
        color_from_depth=RigidTransform(
            rotation=np.array(pose.rot, dtype=float).reshape(3, 3),
            translation_mm=np.array(pose.transform, dtype=float).ravel(),
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Received:
    """A frame as its callback got it; ``picture`` is depth in mm or RGB."""

    number: int
    timestamp_us: int
    received_ns: int
    picture: npt.NDArray[Any]


class OrbbecCamera:
    """See :class:`engine.capture.camera_process.native.NativeCamera`."""

    def __init__(self, serial: str, options: CameraOptions) -> None:
        self._serial, self._options = serial, options
        self._context: ob.Context | None = None
        self._sensors: list[ob.Sensor] = []
        self._queues: tuple[queue.Queue[_Received], ...] = (queue.Queue(QUEUED), queue.Queue(QUEUED))
        self._colors = RecentColors()
        self._clock = DeviceClock(LONGEST_US)
        self._is_file = serial.startswith(FILE)
        self._device: ob.Device | None = None
        self._first: _Received | None = None

    def open(self) -> SourceDescription:
        """Start both streams, wait for their first frames, and fix the exposure.

        Raises
        ------
        SourceLostError
            No such camera; a slow USB connection; another program has it; it delivers nothing, or no times.
        """
        self._context, device = _device(self._serial)
        self._device = device
        info = device.get_device_info()
        name, connection = info.get_name(), info.get_connection_type()
        if connection.startswith("USB") and not connection.startswith("USB3") and not self._is_file:
            raise SourceLostError(f"{name} is connected by {connection}: it needs a USB 3 port and cable")
        if not self._is_file:
            _set_up(device, self._options)
        try:
            profiles = [_profile(device, stream) for stream in (DEPTH, COLOR)]
            for stream, profile in enumerate(profiles):
                sensor = device.get_sensor(SENSORS[stream])
                sensor.start(profile, lambda frame, stream=stream: self._receive(stream, frame))
                self._sensors.append(sensor)
        except ob.OBError as error:
            raise SourceLostError(f"{name} cannot be started: {' '.join(str(error).split())[:300]}") from error
        self._await_first(name)
        if not self._is_file and self._options.exposure_us is None:
            _fix_exposure(device, name)
        return SourceDescription(
            kind="orbbec",
            name=f"{name}, firmware {info.get_firmware_version()}",
            depth_size=(profiles[DEPTH].get_width(), profiles[DEPTH].get_height()),
            color_size=(profiles[COLOR].get_width(), profiles[COLOR].get_height()),
            fps=float(profiles[DEPTH].get_fps()),
            is_live=not self._is_file,
            serial=info.get_serial_number(),
        )

    def _receive(self, stream: int, frame: ob.Frame) -> None:
        """Copy a frame out of the SDK's memory, on its thread; the oldest gives way where no one takes them."""
        received_ns = time.monotonic_ns()
        timestamp_us = int(frame.get_timestamp_us())
        picture = _depth_mm(frame.as_depth_frame()) if stream == DEPTH else _rgb(frame.as_video_frame())
        if timestamp_us == 0 or picture is None:
            return  # its clock does not run yet, or the frame is damaged
        received = _Received(
            number=int(frame.get_index()), timestamp_us=timestamp_us, received_ns=received_ns, picture=picture
        )
        waiting = self._queues[stream]
        if self._is_file:
            with contextlib.suppress(queue.Full):
                waiting.put(received, timeout=FIRST_FRAME_S)
            return
        if waiting.full():
            with contextlib.suppress(queue.Empty):
                waiting.get_nowait()
        waiting.put_nowait(received)  # this thread alone fills it

    def _await_first(self, name: str) -> None:
        """Wait for a frame of each stream that has a time of the device, and let the exposure settle."""
        for stream, what in ((DEPTH, "depth"), (COLOR, "colour")):
            try:
                first = self._queues[stream].get(timeout=FIRST_FRAME_S)
            except queue.Empty as error:
                msg = f"{name} delivers no {what} with a time of its own within {FIRST_FRAME_S:g} s"
                raise SourceLostError(msg) from error
            if stream == COLOR:
                self._take_color(first)
            else:
                self._first = first

    def read(self, timeout_s: float) -> NativeFrame | None:
        """Return the next depth frame with the colour frame nearest to it among those that have come.

        Raises
        ------
        SourceLostError
            The camera was unplugged.
        """
        empty_ns = time.monotonic_ns() if self._queues[DEPTH].empty() else None
        depth, self._first = self._first, None
        try:
            depth = depth or self._queues[DEPTH].get(timeout=timeout_s)
        except queue.Empty:
            self._refuse_end()
            return None
        with contextlib.suppress(queue.Empty):
            while True:
                self._take_color(self._queues[COLOR].get_nowait())
        timestamp_us = self._clock.unwrapped(depth.timestamp_us)
        color = None if timestamp_us is None else self._colors.nearest(timestamp_us)
        if timestamp_us is None or color is None:
            return None
        return NativeFrame(
            number=depth.number,
            timestamp_us=timestamp_us,
            color_timestamp_us=color[0],
            received_ns=depth.received_ns,
            queue_empty_ns=empty_ns,
            depth_mm=depth.picture,
            color=color[1],
        )

    def _take_color(self, color: _Received) -> None:
        timestamp_us = self._clock.unwrapped(color.timestamp_us)
        if timestamp_us is not None:
            self._colors.add(timestamp_us, color.picture)

    def _refuse_end(self) -> None:
        """Raise SourceLostError where the device is gone, SourceEndedError after a recording: both only fall silent."""
        assert self._device is not None
        if self._is_file:
            if self._device.get_playback_status() == ob.OBPlaybackStatus.STOPPED:
                msg = "the recording has ended"
                raise SourceEndedError(msg)
        elif f"{PREFIX}{self._serial}" not in [one.uri for one in list_cameras()]:
            msg = "the Orbbec camera was disconnected"
            raise SourceLostError(msg)

    def temperature_c(self) -> float | None:
        """Return the temperature of the depth sensor, or of its projector."""
        if self._device is None or self._is_file:
            return None
        try:
            reported = self._device.get_temperature()
        except ob.OBError:
            return None
        return next((float(one) for one in (reported.ir_temperature, reported.laser_temperature) if one > 0.0), None)

    def close(self) -> None:
        """Stop the streams; it may hang."""
        while self._sensors:
            with contextlib.suppress(ob.OBError):
                self._sensors.pop().stop()


def _device(serial: str) -> tuple[ob.Context, ob.Device]:
    """Return a camera and the context that it lives in."""
    context = ob.Context()
    if serial.startswith(FILE):
        try:
            return context, ob.PlaybackDevice(serial.removeprefix(FILE))
        except ob.OBError as error:
            raise SourceLostError(f"{serial.removeprefix(FILE)} is no recording of the SDK: {error}") from error
    try:
        return context, context.query_devices().get_device_by_serial_number(serial)
    except ob.OBError as error:
        raise SourceLostError(f"no Orbbec camera {serial} is connected, or another program has it") from error


def _profile(device: ob.Device, stream: int) -> ob.VideoStreamProfile:
    """Return the profile of a stream nearest to 640 x 480, of those with 30 frames/s and a known format."""
    profiles = device.get_sensor(SENSORS[stream]).get_stream_profile_list()
    found = [profiles.get_stream_profile_by_index(i).as_video_stream_profile() for i in range(profiles.get_count())]
    usable = [one for one in found if one.get_fps() == FPS and one.get_format() in FORMATS[stream]]
    if not usable:
        what = ("depth", "colour")[stream]
        raise SourceLostError(f"the camera has no {what} at {FPS} frames/s that can be read: is it on a USB 3 port?")

    def away(one: ob.VideoStreamProfile) -> tuple[int, int]:
        size = abs(one.get_width() - SIZE_PX[0]) + abs(one.get_height() - SIZE_PX[1])
        return size, FORMATS[stream].index(one.get_format())

    return min(usable, key=away)


def _depth_mm(frame: ob.DepthFrame) -> DepthImage | None:
    size = frame.get_height(), frame.get_width()
    raw = np.frombuffer(frame.get_data(), np.uint16)
    return in_mm(raw.reshape(size), frame.get_depth_scale()).copy() if raw.size == size[0] * size[1] else None


def _rgb(frame: ob.VideoFrame) -> ColorImage | None:
    raw = np.frombuffer(frame.get_data(), np.uint8)
    if frame.get_format() == ob.OBFormat.MJPG:
        decoded = cv2.imdecode(raw, cv2.IMREAD_COLOR)
        return None if decoded is None else np.ascontiguousarray(decoded[..., ::-1])
    size = frame.get_height(), frame.get_width(), 3
    if raw.size != int(np.prod(size)):
        return None
    picture = raw.reshape(size)
    return np.array(picture if frame.get_format() == ob.OBFormat.RGB else picture[..., ::-1])


def _set_up(device: ob.Device, options: CameraOptions) -> None:
    """Set what the site has chosen, and read it back; a preset comes first, as it changes the others.

    Raises
    ------
    SourceLostError
        The camera has no such preset or property, or does not take the value.
    """
    if options.preset is not None:
        presets = device.get_available_preset_list()
        names = [presets.get_name_by_index(i) for i in range(presets.get_count())]
        if options.preset not in names:
            raise SourceLostError(
                f"camera.depth_preset is {options.preset}: this camera has {', '.join(names) or 'none'}"
            )
        device.load_preset(options.preset)
        if device.get_current_preset_name() != options.preset:
            raise SourceLostError(f"this camera does not take camera.depth_preset {options.preset}")
    if options.laser_percent is not None:
        power = ob.OBPropertyID.OB_PROP_LASER_POWER_LEVEL_CONTROL_INT
        bounds = _bounds(device, power, "laser_percent")
        _set(device, power, bounds.min + round((bounds.max - bounds.min) * options.laser_percent / 100.0))
    if options.exposure_us is not None:
        exposure, automatic = (
            ob.OBPropertyID.OB_PROP_DEPTH_EXPOSURE_INT,
            ob.OBPropertyID.OB_PROP_DEPTH_AUTO_EXPOSURE_BOOL,
        )
        _bounds(device, exposure, "depth_exposure_us")
        if device.is_property_supported(automatic, ob.OBPermissionType.PERMISSION_READ_WRITE):
            device.set_bool_property(automatic, False)  # noqa: FBT003 - the SDK's own signature
        _set(device, exposure, options.exposure_us)


def _bounds(device: ob.Device, what: ob.OBPropertyID, setting: str) -> ob.OBIntPropertyRange:
    if not device.is_property_supported(what, ob.OBPermissionType.PERMISSION_READ_WRITE):
        raise SourceLostError(f"camera.{setting} cannot be set on this camera")
    return device.get_int_property_range(what)


def _set(device: ob.Device, what: ob.OBPropertyID, value: int) -> None:
    try:
        device.set_int_property(what, value)
    except ob.OBError as error:
        raise SourceLostError(f"{what.name} cannot be {value}: {' '.join(str(error).split())[:300]}") from error
    found = device.get_int_property(what)
    if found != value:
        raise SourceLostError(f"{what.name} is {found} although {value} was set")


def _fix_exposure(device: ob.Device, name: str) -> None:
    """Let the exposure of depth settle and stay: one that follows the scene changes noise and bias while gating."""
    option = ob.OBPropertyID.OB_PROP_DEPTH_AUTO_EXPOSURE_BOOL
    if not device.is_property_supported(option, ob.OBPermissionType.PERMISSION_READ_WRITE):
        return  # a time-of-flight camera has none
    if device.get_bool_property(option):
        time.sleep(SETTLE_S)
        device.set_bool_property(option, False)  # noqa: FBT003 - the SDK's own signature
    if device.get_bool_property(option):
        raise SourceLostError(f"{name} does not fix the exposure of depth")


def _intrinsics(profile: ob.VideoStreamProfile) -> Intrinsics:
    """Return OpenCV's parameters of a camera; other models of its lens than OpenCV's five are fitted."""
    given, lens = profile.get_intrinsic(), profile.get_distortion()
    plain = Intrinsics(width=given.width, height=given.height, fx=given.fx, fy=given.fy, cx=given.cx, cy=given.cy)
    rational = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
    if not any(rational):
        return plain
    if not any(rational[5:]):
        return with_distortion(plain, rational[:5])
    pixels = grid_px(plain)
    rays = (pixels - (plain.cx, plain.cy)) / (plain.fx, plain.fy)
    points = np.column_stack([rays, np.ones(len(rays))])
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), plain.matrix, np.array(rational))
    return fitted(plain, np.asarray(seen, dtype=np.float64).reshape(-1, 2), rays)
