"""The real ``pyrealsense2``, whose context has one device: librealsense's software device, fed with a virtual Xtion.

``CAMERA_SDK_PATH`` lets the camera's process import this in place of the wheel, as ``OPENNI2_REDIST`` names
another runtime. Frames pass through librealsense: queues, profiles, formats, options and numbers are the real ones.

``VIRTUAL_REALSENSE`` is JSON: ``block`` and ``redist`` a virtual Xtion's, ``cable`` a file that is there while it is
plugged in, and what is wrong with the device (see `tests.support.realsense.camera.environment`).
"""

import importlib
import json
import os
import sys
import threading
import time
from pathlib import Path

HERE = str(Path(__file__).parents[1])
GIVEN = json.loads(os.environ["VIRTUAL_REALSENSE"])


def _real():
    """Import the wheel's package in place of this one."""
    path, mine = list(sys.path), sys.modules.pop(__name__)
    sys.path[:] = [one for one in path if one != HERE]
    try:
        return importlib.import_module(__name__)
    finally:
        sys.path[:] = path
        sys.modules[__name__] = mine


rs = _real()
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
        self.sensors[which].on_video_frame(made)


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

    def stop(self):
        if GIVEN.get("hangs") == "stop":
            time.sleep(3600)
        self._sensor.stop()

    def __getattr__(self, name):
        return getattr(self._sensor, name)
