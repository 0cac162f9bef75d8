"""RealSense cameras in the camera's process: the only module that imports ``pyrealsense2``.

Depth and colour are 640 x 480 at 30 frames/s. Times are the device's own, in its hardware clock: the SDK's global time,
which is estimated from the host's and was seen to jump by years, is off, and a camera without times of its own is
refused. The exposure of depth is found automatically in the first second and stays as it was found.
"""

import time
from contextlib import suppress

import numpy as np
import pyrealsense2 as rs

from engine.capture.camera_process.lens import fitted, grid_px, with_distortion
from engine.capture.camera_process.native import (
    FILE,
    FIRST_FRAME_S,
    FPS,
    INFRARED,
    SETTLE_S,
    SIZE_PX,
    DeviceClock,
    NativeFrame,
    in_mm,
)
from engine.capture.camera_process.pairing import RecentColors
from engine.capture.source import CameraOptions, FactoryCalibration, ListedCamera, SourceDescription
from engine.core.errors import SourceEndedError, SourceLostError
from engine.core.geometry import Intrinsics, RigidTransform

PREFIX = "realsense:"
WRAP_US = 2**32
"""The device counts microseconds with 32 bits: 71.6 minutes."""
QUEUED, QUEUED_OF_FILE = 32, 128
MM_PER_M = 1000.0
COLOR_AXES = 3
DEPTH_UNIT_M = 0.001
FORMATS = {rs.stream.depth: rs.format.z16, rs.stream.color: rs.format.rgb8, rs.stream.infrared: rs.format.y8}
WANTED = (
    (rs.option.global_time_enabled, 0.0),
    (rs.option.depth_units, DEPTH_UNIT_M),
    (rs.option.emitter_enabled, 1.0),
    (rs.option.enable_auto_exposure, 1.0),
    (rs.option.auto_exposure_priority, 0.0),
)
"""Options before the start: the device's own time, depth in mm, the projector on, no frame longer than its period."""


def list_cameras() -> list[ListedCamera]:
    """List the connected cameras that have depth and colour; one with infrared pictures a second time, with those."""
    found = []
    for device in rs.context().query_devices():
        serial, name = _info(device, rs.camera_info.serial_number), _info(device, rs.camera_info.name) or "RealSense"
        for behind, words in (("", ""), (INFRARED, ", infrared")):
            if serial and all(_sensor(device, kind) is not None for kind in _streams(behind)):
                found.append(ListedCamera(uri=f"{PREFIX}{serial}{behind}", vendor="Intel", name=name + words))
    return found


def camera(serial: str, options: CameraOptions) -> "RealSenseCamera":
    """Return the camera with a serial number, not opened."""
    return RealSenseCamera(serial, options)


def factory_calibration(serial: str) -> FactoryCalibration:
    """Return the calibration that a camera has from its maker; raise SourceLostError without the camera."""
    device = _device(serial)
    depth, color = (_profile(device, kind, is_any=serial.startswith(FILE)) for kind in _streams(serial))
    pose = depth.get_extrinsics_to(color)
    return FactoryCalibration(
        camera=_info(device, rs.camera_info.name) or "RealSense",
        serial=_info(device, rs.camera_info.serial_number),
        depth=_intrinsics(depth.get_intrinsics()),
        color=_intrinsics(color.get_intrinsics()),
        color_from_depth=RigidTransform(
            rotation=np.array(pose.rotation, dtype=float).reshape(3, 3).T,
            translation_mm=MM_PER_M * np.array(pose.translation, dtype=float),
        ),
    )


def _streams(serial: str) -> tuple[rs.stream, rs.stream]:
    """Return the streams of a camera's address: depth, and the picture that the markers are found in."""
    return rs.stream.depth, rs.stream.infrared if serial.endswith(INFRARED) else rs.stream.color


class RealSenseCamera:
    """See :class:`engine.capture.camera_process.native.NativeCamera`."""

    def __init__(self, serial: str, options: CameraOptions) -> None:
        self._serial, self._options = serial, options
        self._streams = _streams(serial)
        self._started: list[rs.sensor] = []
        self._is_file = serial.startswith(FILE)
        kept = QUEUED_OF_FILE if self._is_file else QUEUED
        self._queues = {kind: rs.frame_queue(kept, keep_frames=True) for kind in self._streams}
        self._colors = RecentColors()
        self._clock = DeviceClock(WRAP_US)
        self._unit_mm = MM_PER_M * DEPTH_UNIT_M
        self._device: rs.device | None = None

        self._first: rs.frame | None = None

    def open(self) -> SourceDescription:
        """Start both streams, wait for their first frames, and fix the exposure.

        Raises
        ------
        SourceLostError
            No such camera or recording; a slow USB connection; another program has it; it delivers nothing, or no times
            of its own.
        """
        device = self._device = _device(self._serial)
        name = _info(device, rs.camera_info.name) or "RealSense"
        usb = _info(device, rs.camera_info.usb_type_descriptor)
        if usb and not usb.startswith("3") and not self._is_file:
            raise SourceLostError(f"{name} is connected by USB {usb}: it needs a USB 3 port and cable")
        try:
            profiles = {kind: _profile(device, kind, is_any=self._is_file) for kind in self._streams}
            sensors = _grouped(device, self._streams)
            for sensor, kinds in sensors:
                if not self._is_file:
                    _set_up(sensor, kinds[0], self._options)
                sensor.open([profiles[kind] for kind in kinds])
            for sensor, kinds in sensors:
                sensor.start(self._queues[kinds[0]] if len(kinds) == 1 else self._sorted)
                self._started.append(sensor)
        except RuntimeError as error:
            raise SourceLostError(f"{name} cannot be started: {_words(error)}") from error
        self._unit_mm = MM_PER_M * _option(self._started[0], rs.option.depth_units, DEPTH_UNIT_M)
        self._await_first(name)
        if not self._is_file:
            self._settle(name)
        name += ", infrared" if rs.stream.infrared in self._streams else ""
        firmware = _info(device, rs.camera_info.firmware_version)
        return SourceDescription(
            kind="realsense",
            name=f"{name}, firmware {firmware}" if firmware else name,
            depth_size=(profiles[rs.stream.depth].width(), profiles[rs.stream.depth].height()),
            color_size=(profiles[self._streams[1]].width(), profiles[self._streams[1]].height()),
            fps=float(profiles[rs.stream.depth].fps()),
            is_live=not self._is_file,
            serial=_info(device, rs.camera_info.serial_number),
        )

    def _sorted(self, frame: rs.frame) -> None:
        """Take a frame of a sensor that has both streams, on the SDK's thread."""
        self._queues[frame.get_profile().stream_type()].enqueue(frame)

    def _await_first(self, name: str) -> None:
        """Wait for a frame of each stream with times of the device."""
        for kind in self._streams:
            try:
                frame = self._queues[kind].wait_for_frame(int(1000 * FIRST_FRAME_S))
            except RuntimeError as error:
                raise SourceLostError(f"{name} delivers no {kind.name} within {FIRST_FRAME_S:g} s") from error
            if frame.get_frame_timestamp_domain() != rs.timestamp_domain.hardware_clock:
                msg = (
                    f"{name} delivers no times of its own: the kernel's patches or the SDK's own USB backend are needed"
                )
                raise SourceLostError(msg)
            if kind == rs.stream.depth:
                self._first = frame
            else:
                self._take_color(frame)

    def _settle(self, name: str) -> None:
        """Let the exposure of depth settle, and fix it."""
        settled_s = time.monotonic() + SETTLE_S
        depth = self._started[0]
        if self._options.exposure_us is not None:
            return  # it was set before the start
        while depth.supports(rs.option.enable_auto_exposure) and time.monotonic() < settled_s:
            time.sleep(0.05)
            self._take_colors()
            while self._queues[rs.stream.depth].poll_for_frame():
                pass
        _fix_exposure(depth, name)

    def read(self, timeout_s: float) -> NativeFrame | None:
        """Return the next depth frame with the colour frame nearest to it among those that have come.

        Raises
        ------
        SourceLostError
            The camera was unplugged.
        """
        deadline_s = time.monotonic() + timeout_s
        queue, empty_ns = self._queues[rs.stream.depth], None
        frame, self._first = self._first, None
        while not frame and not (frame := queue.poll_for_frame()):
            empty_ns = time.monotonic_ns()
            left_ms = int(1000 * (deadline_s - time.monotonic()))
            if left_ms <= 0:
                self._refuse_end()
                return None
            is_there, frame = queue.try_wait_for_frame(left_ms)
            if is_there:
                break
        received_ns = time.monotonic_ns()
        self._take_colors()
        timestamp_us = self._clock.unwrapped(_time_us(frame))
        color = None if timestamp_us is None else self._colors.nearest(timestamp_us)
        if timestamp_us is None or color is None:
            return None
        return NativeFrame(
            number=int(frame.get_frame_number()),
            timestamp_us=timestamp_us,
            color_timestamp_us=color[0],
            received_ns=received_ns,
            queue_empty_ns=empty_ns,
            depth_mm=in_mm(np.asanyarray(frame.get_data()), self._unit_mm),
            color=color[1],
        )

    def _take_colors(self) -> None:
        while frame := self._queues[self._streams[1]].poll_for_frame():
            self._take_color(frame)

    def _take_color(self, frame: rs.frame) -> None:
        timestamp_us = self._clock.unwrapped(_time_us(frame))
        if timestamp_us is not None:
            picture = np.array(frame.get_data(), dtype=np.uint8)
            is_gray = picture.ndim < COLOR_AXES
            self._colors.add(timestamp_us, np.repeat(picture[..., None], 3, axis=2) if is_gray else picture)

    def _refuse_end(self) -> None:
        """Raise SourceLostError where the device is gone, SourceEndedError after a recording: both only fall silent."""
        assert self._device is not None
        if self._is_file:
            if self._device.as_playback().current_status() == rs.playback_status.stopped:
                msg = "the recording has ended"
                raise SourceEndedError(msg)
        elif not self._device.is_connected():
            msg = "the RealSense camera was disconnected"
            raise SourceLostError(msg)

    def temperature_c(self) -> float | None:
        """Return the temperature of the projector, or of the chip that computes depth."""
        for option in (rs.option.projector_temperature, rs.option.asic_temperature):
            with suppress(RuntimeError):
                if self._started and self._started[0].supports(option):
                    return float(self._started[0].get_option(option))
        return None

    def close(self) -> None:
        """Stop the streams; it may hang."""
        while self._started:
            sensor = self._started.pop()
            with suppress(RuntimeError):
                sensor.stop()
                sensor.close()


def _device(serial: str) -> rs.device:
    serial = serial.removesuffix(INFRARED)
    if serial.startswith(FILE):
        try:
            return rs.context().load_device(serial.removeprefix(FILE))
        except RuntimeError as error:
            raise SourceLostError(f"{serial.removeprefix(FILE)} is no recording of the SDK: {_words(error)}") from error
    for device in rs.context().query_devices():
        if _info(device, rs.camera_info.serial_number) == serial:
            return device
    raise SourceLostError(f"no RealSense camera {serial} is connected")


def _info(device: rs.device, what: rs.camera_info) -> str:
    return str(device.get_info(what)) if device.supports(what) else ""


def _sensor(device: rs.device, kind: rs.stream) -> rs.sensor | None:
    """Return the first sensor that has a stream, None without one."""
    return next((sensor for sensor in device.query_sensors() if _has(sensor, kind)), None)


def _has(sensor: rs.sensor, kind: rs.stream) -> bool:
    return any(profile.stream_type() == kind for profile in sensor.get_stream_profiles())


def _grouped(device: rs.device, streams: tuple[rs.stream, rs.stream]) -> list[tuple[rs.sensor, tuple[rs.stream, ...]]]:
    """Return the sensors that are needed, that of depth first, each with its streams: some have both."""
    found: list[tuple[rs.sensor, tuple[rs.stream, ...]]] = []
    left = streams
    for sensor in sorted(device.query_sensors(), key=lambda one: not _has(one, streams[0])):
        own = tuple(kind for kind in left if _has(sensor, kind))
        left = tuple(kind for kind in left if kind not in own)
        if own:
            found.append((sensor, own))
    return found


def _profile(device: rs.device, kind: rs.stream, *, is_any: bool = False) -> rs.video_stream_profile:
    """Return the profile of a stream with the size, rate and format that are used, or as it was recorded."""
    sensor = _sensor(device, kind)
    # Of two infrared pictures the first is that of the camera in which depth is computed.
    offered = [] if sensor is None else sorted(sensor.get_stream_profiles(), key=lambda one: one.stream_index())
    for profile in offered:
        if profile.stream_type() != kind or profile.format() != FORMATS[kind]:
            continue
        video = profile.as_video_stream_profile()
        if is_any or (video.fps() == FPS and (video.width(), video.height()) == SIZE_PX):
            return video
    size = f"{SIZE_PX[0]} x {SIZE_PX[1]}"
    raise SourceLostError(f"the camera has no {kind.name} of {size} at {FPS} frames/s: is it on a USB 3 port?")


def _set_up(sensor: rs.sensor, kind: rs.stream, options: CameraOptions) -> None:
    """Set the options that a sensor has, and read each back; raise SourceLostError for one that is not taken.

    What the site has chosen has to be there. A preset comes first: it changes the others.
    """
    is_depth = kind == rs.stream.depth
    if is_depth and options.preset is not None:
        _demand(sensor, rs.option.visual_preset, _preset(options.preset), "depth_preset")
    for option, value in WANTED:
        if sensor.supports(option) and not sensor.is_option_read_only(option):
            _set(sensor, option, value, kind.name)
    if is_depth and options.laser_percent is not None:
        _demand(sensor, rs.option.laser_power, None, "laser_percent")
        bounds = sensor.get_option_range(rs.option.laser_power)
        steps = round((bounds.max - bounds.min) * options.laser_percent / 100.0 / (bounds.step or 1.0))
        _set(sensor, rs.option.laser_power, bounds.min + steps * (bounds.step or 1.0), kind.name)
    if is_depth and options.exposure_us is not None:
        _demand(sensor, rs.option.exposure, None, "depth_exposure_us")
        if sensor.supports(rs.option.enable_auto_exposure):
            _set(sensor, rs.option.enable_auto_exposure, 0.0, kind.name)
        _set(sensor, rs.option.exposure, float(options.exposure_us), kind.name)


def _preset(name: str) -> float:
    found = getattr(rs.rs400_visual_preset, name.replace("-", "_"), None)
    if not isinstance(found, rs.rs400_visual_preset):
        names = ", ".join(one.replace("_", "-") for one in rs.rs400_visual_preset.__members__)
        raise SourceLostError(f"camera.depth_preset is {name}: this camera has {names}")
    return float(int(found))


def _demand(sensor: rs.sensor, option: rs.option, value: float | None, setting: str) -> None:
    """Refuse a camera without an option that the site has chosen; set it where a value is given."""
    if not sensor.supports(option) or sensor.is_option_read_only(option):
        raise SourceLostError(f"this camera has no {option.name.replace('_', ' ')}: camera.{setting} cannot be set")
    if value is not None:
        _set(sensor, option, value, "depth")


def _set(sensor: rs.sensor, option: rs.option, value: float, what: str) -> None:
    try:
        sensor.set_option(option, value)
    except RuntimeError as error:
        raise SourceLostError(f"{what} {option.name.replace('_', ' ')} cannot be {value:g}: {_words(error)}") from error
    found = sensor.get_option(option)
    if abs(found - value) > 1e-3 * max(abs(value), 1e-3):
        raise SourceLostError(f"{what} {option.name.replace('_', ' ')} is {found:g} although {value:g} was set")


def _fix_exposure(sensor: rs.sensor, name: str) -> None:
    """Let the exposure of depth stay as it is: one that follows the scene changes noise and bias while gating."""
    if not sensor.supports(rs.option.enable_auto_exposure) or sensor.is_option_read_only(
        rs.option.enable_auto_exposure
    ):
        return
    exposure = _option(sensor, rs.option.exposure, 0.0)
    _set(sensor, rs.option.enable_auto_exposure, 0.0, name)
    if exposure > 0.0 and not sensor.is_option_read_only(rs.option.exposure):
        _set(sensor, rs.option.exposure, exposure, name)


def _option(sensor: rs.sensor, option: rs.option, default: float) -> float:
    return float(sensor.get_option(option)) if sensor.supports(option) else default


def _time_us(frame: rs.frame) -> int:
    return round(1000.0 * float(frame.get_timestamp()))


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__


def _intrinsics(given: rs.intrinsics) -> Intrinsics:
    """Return OpenCV's parameters of a camera; other models of its lens than OpenCV's are fitted."""
    plain = Intrinsics(width=given.width, height=given.height, fx=given.fx, fy=given.fy, cx=given.ppx, cy=given.ppy)
    if not any(given.coeffs):
        return plain
    if given.model == rs.distortion.brown_conrady:
        return with_distortion(plain, given.coeffs)
    pixels = grid_px(plain)
    if given.model == rs.distortion.inverse_brown_conrady:
        rays = [rs.rs2_deproject_pixel_to_point(given, pixel, 1.0)[:2] for pixel in pixels.tolist()]
        return fitted(plain, pixels, np.array(rays))
    # The SDK has no inverse of the other models: pixels of rays in place of rays of pixels.
    rays = (pixels - (given.ppx, given.ppy)) / (given.fx, given.fy)
    seen = [rs.rs2_project_point_to_pixel(given, [*ray, 1.0]) for ray in rays.tolist()]
    return fitted(plain, np.array(seen), rays)
