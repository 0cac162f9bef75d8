"""The real ``pyrealsense2``, whose context has one device: librealsense's software device, fed with a virtual Xtion.

``CAMERA_SDK_PATH`` lets the camera's process import this in place of the wheel, as ``OPENNI2_REDIST`` names
another runtime. Frames pass through librealsense: queues, profiles, formats, options and numbers are the real ones.

``VIRTUAL_REALSENSE`` is JSON: ``block`` and ``redist`` a virtual Xtion's, ``cable`` a file that is there while it is
plugged in, and what is wrong with the device (see `tests.support.realsense.camera.environment`).
"""

import json
import os
import threading
import time
from pathlib import Path

import cv2
import numpy as np

from tests.support.capture.sdk_cameras import real_package

GIVEN = json.loads(os.environ["VIRTUAL_REALSENSE"])


rs = real_package(__name__, str(Path(__file__).parents[1]))
globals().update({name: getattr(rs, name) for name in dir(rs) if not name.startswith("__")})

SERIAL = GIVEN.get("serial", "0123456789")
WIDTH, HEIGHT = 640, 480
UNIT_M = GIVEN.get("unit_m", 0.001)
DOMAIN = getattr(rs.timestamp_domain, GIVEN.get("domain", "hardware_clock"))
CLOCK_US = GIVEN.get("clock_us", 0)


def _intrinsics(camera):
    made = rs.intrinsics()
    made.width, made.height = camera["width"], camera["height"]
    made.fx, made.fy, made.ppx, made.ppy = camera["fx"], camera["fy"], camera["cx"], camera["cy"]
    made.model = rs.distortion.brown_conrady
    made.coeffs = list(camera["distortion"])
    return made


def _stream(kind, name_format, bpp, uid, camera):
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid = kind, 0, uid
    stream.width, stream.height, stream.fps, stream.bpp, stream.fmt = WIDTH, HEIGHT, 30, bpp, name_format
    stream.intrinsics = _intrinsics(camera)
    return stream


OPTIONS = (
    ("visual_preset", 0.0, 6.0, 1.0, 0.0),
    ("enable_auto_exposure", 0.0, 1.0, 1.0, 1.0),
    ("exposure", 1.0, 165_000.0, 1.0, 8_500.0),
    ("laser_power", 0.0, 360.0, 30.0, 150.0),
)
"""Options of a D435's stereo module: least, most, step, default."""


class ViewOfDepth:
    """What the depth camera itself would see: brightness of the colour picture at each depth pixel's point.

    The place in the colour picture is computed for every eighth pixel and interpolated between them: computed for all,
    it takes longer than a frame's period on a slow processor, and the frames of the device become old.
    """

    STEP = 8

    def __init__(self, calibration):
        from engine.calibration import parse_calibration

        known = parse_calibration(json.dumps(calibration).encode())
        first = (self.STEP - 1) / 2.0  # the middle of each square, as cv2.resize takes it
        rows, columns = np.mgrid[first : HEIGHT : self.STEP, first : WIDTH : self.STEP]
        self._shape = rows.shape
        self._rays = known.depth.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
        self._color, self._pose = known.color, known.color_from_depth

    def infrared(self, depth_mm, color):
        squares = depth_mm[self.STEP // 2 :: self.STEP, self.STEP // 2 :: self.STEP]
        z_mm = np.where(squares > 0, squares, np.median(squares[squares > 0])).reshape(-1, 1)
        seen = self._color.project(self._pose.apply(self._rays * z_mm)).reshape(*self._shape, 2).astype(np.float32)
        seen = cv2.resize(seen, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
        gray = cv2.cvtColor(np.asarray(color), cv2.COLOR_RGB2GRAY)
        return np.ascontiguousarray(cv2.remap(gray, seen[..., 0], seen[..., 1], cv2.INTER_LINEAR))


class VirtualDevice:
    """A software device, and the thread that feeds it."""

    def __init__(self):
        calibration = json.loads(Path(GIVEN["calibration"]).read_text())
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Virtual D435")
        self.device.register_info(rs.camera_info.serial_number, SERIAL)
        self.device.register_info(rs.camera_info.usb_type_descriptor, GIVEN.get("usb", "3.2"))
        self.device.register_info(rs.camera_info.firmware_version, "5.16.0.1")
        self.sensors = [self.device.add_sensor("Stereo Module"), self.device.add_sensor("RGB Camera")]
        depth = _stream(rs.stream.depth, rs.format.z16, 2, 1, calibration["depth"])
        color = _stream(rs.stream.color, rs.format.rgb8, 3, 2, calibration["color"])
        self.profiles = [one.add_video_stream(stream) for one, stream in zip(self.sensors, (depth, color), strict=True)]
        pose = rs.extrinsics()
        rotation = calibration["depth_to_color"]["rotation"]
        pose.rotation = [rotation[row][column] for column in range(3) for row in range(3)]
        pose.translation = [mm / 1000.0 for mm in calibration["depth_to_color"]["translation_mm"]]
        self.profiles[0].register_extrinsics_to(self.profiles[1], pose)
        if GIVEN.get("infrared"):
            left = _stream(rs.stream.infrared, rs.format.y8, 1, 3, calibration["depth"])
            left.index = 1
            self.profiles.append(self.sensors[0].add_video_stream(left))
            same = rs.extrinsics()
            same.rotation, same.translation = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
            self.profiles[0].register_extrinsics_to(self.profiles[2], same)
            self._view = ViewOfDepth(calibration)
        if GIVEN.get("temperature_c"):
            self.sensors[0].add_read_only_option(rs.option.asic_temperature, GIVEN["temperature_c"])
        for name, low, high, step, default in OPTIONS if GIVEN.get("options") else ():
            bounds = rs.option_range()
            bounds.min, bounds.max, bounds.step, bounds.default = low, high, step, default
            self.sensors[0].add_option(getattr(rs.option, name), bounds, True)
        self.sensors[0].add_read_only_option(rs.option.depth_units, UNIT_M)
        threading.Thread(target=self._feed, daemon=True).start()

    def _feed(self):
        os.environ.update(OPENNI2_REDIST=GIVEN["redist"], VIRTUAL_XTION=GIVEN["block"])
        from engine.capture.openni.source import OpenNiSource
        from engine.core.clock import MonotonicClock
        from engine.core.errors import FrameTimeoutError, SourceLostError

        source, color_us = OpenNiSource(None, clock=MonotonicClock()), None
        try:
            source.open()
            while _is_plugged():
                try:
                    frame = source.read(0.1)
                except FrameTimeoutError:
                    continue
                if frame.color_timestamp_us != color_us:
                    color_us = frame.color_timestamp_us
                    self._push(1, frame.color, 3, color_us, frame.device_index)
                if GIVEN.get("infrared"):
                    seen = self._view.infrared(frame.depth_mm, frame.color)
                    self._push(2, seen, 1, frame.timestamp_us, frame.device_index)
                self._push(
                    0, (frame.depth_mm / (1000.0 * UNIT_M)).astype("uint16"), 2, frame.timestamp_us, frame.device_index
                )
        except SourceLostError:
            return  # the device delivers no more, as one that was unplugged

    def _push(self, which, picture, bpp, timestamp_us, number):
        made = rs.software_video_frame()
        made.pixels, made.stride, made.bpp = picture, WIDTH * bpp, bpp
        made.timestamp = ((timestamp_us + CLOCK_US) % 2**32) / 1000.0
        made.domain, made.frame_number = DOMAIN, number
        made.profile = self.profiles[which].as_video_stream_profile()
        if which == 0:
            made.depth_units = UNIT_M
        self.sensors[which % 2].on_video_frame(made)


class context:  # noqa: N801 - the name of the SDK
    """What the SDK's context would find: the virtual device, while it is plugged in."""

    def query_devices(self):
        if not _is_plugged():
            return []
        if GIVEN.get("hangs") == "query":
            time.sleep(3600)
        return [_wrapped()]


def _is_plugged():
    return Path(GIVEN["cable"]).exists()


_made = []


def _wrapped():
    """The one device of this process: made when it is first asked for, streaming from then on."""
    if not _made:
        _made.append(_Device(VirtualDevice()))
    return _made[0]


class _Device:
    """The software device as the adapter sees it: a pulled cable is its only difference."""

    def __init__(self, virtual):
        self._virtual = virtual

    def is_connected(self):
        return _is_plugged()

    def query_sensors(self):
        return [_Sensor(one) for one in self._virtual.device.query_sensors()]

    def __getattr__(self, name):
        return getattr(self._virtual.device, name)


class _Sensor:
    """A sensor whose calls hang or fail where that is asked for."""

    def __init__(self, sensor):
        self._sensor = sensor

    def open(self, profile):
        if GIVEN.get("busy"):
            raise RuntimeError("xioctl(VIDIOC_S_FMT) failed, errno=16 Last Error: Device or resource busy")
        self._sensor.open(profile)

    def start(self, receiver):
        self._note("start")
        self._sensor.start(receiver)

    def _note(self, when):
        """Write down the options of a sensor that has them."""
        path = Path(GIVEN["cable"]).with_suffix(".options")
        if GIVEN.get("options") and self._sensor.supports(rs.option.laser_power):
            noted = json.loads(path.read_text()) if path.exists() else {}
            noted[when] = {name: self._sensor.get_option(getattr(rs.option, name)) for name, *_ in OPTIONS}
            path.write_text(json.dumps(noted))

    def stop(self):
        self._note("stop")
        if GIVEN.get("hangs") == "stop":
            time.sleep(3600)
        self._sensor.stop()

    def __getattr__(self, name):
        return getattr(self._sensor, name)
