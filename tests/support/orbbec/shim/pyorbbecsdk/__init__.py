"""The real ``pyorbbecsdk``, whose context has one device: the SDK's own playback of a recording.

``VIRTUAL_ORBBEC`` is JSON: ``bag`` the recording, ``cable`` a file that is there while the camera is plugged in,
``hangs`` a call that never returns. With ``block`` and ``redist`` of a virtual Xtion its frames are delivered without
end, as frames of the SDK, and the recording says what the camera is.
"""

import json
import os
import threading
import time
from pathlib import Path

from tests.support.capture.sdk_cameras import real_package

GIVEN = json.loads(os.environ["VIRTUAL_ORBBEC"])


ob = real_package(__name__, str(Path(__file__).parents[1]))
globals().update({name: getattr(ob, name) for name in dir(ob) if not name.startswith("__")})


class Context:
    """What the SDK's context would find: the playback, while it is plugged in."""

    set_logger_level = ob.Context.set_logger_level

    def query_devices(self):
        return _Devices()


class _Devices:
    def get_count(self):
        return int(Path(GIVEN["cable"]).exists())

    def get_device_serial_number_by_index(self, _index):
        return _info().get_serial_number()

    def get_device_name_by_index(self, _index):
        return _info().get_name()

    def get_device_by_serial_number(self, serial):
        if not self.get_count() or serial != _info().get_serial_number():
            raise ob.OBError("no such device")
        return _Device(_playback())


_made = []


def _playback():
    if not _made:
        _made.append(ob.PlaybackDevice(GIVEN["bag"]))
    return _made[0]


def _info():
    return _playback().get_device_info()


_receivers = {}


class _Fed:
    """A frame of the SDK with the number and the time of a virtual Xtion's, which the SDK lets no one set."""

    def __init__(self, profile, picture, number, timestamp_us):
        self._frame = ob.Frame.create_frame_from_stream_profile(profile)
        self._frame.update_data(picture.view("uint8").ravel())
        self._number, self._timestamp_us = number, timestamp_us

    def get_index(self):
        return self._number

    def get_timestamp_us(self):
        return self._timestamp_us

    def __getattr__(self, name):
        return getattr(self._frame, name)


def _feed():
    os.environ.update(OPENNI2_REDIST=GIVEN["redist"], VIRTUAL_XTION=GIVEN["block"])
    from engine.capture.openni.source import OpenNiSource
    from engine.core.clock import MonotonicClock
    from engine.core.errors import FrameTimeoutError, SourceLostError

    def deliver(kind, picture, number, timestamp_us):
        profile, receive = _receivers[kind]
        receive(_Fed(profile, picture, number, timestamp_us))

    source, color_us = OpenNiSource(None, clock=MonotonicClock()), None
    try:
        source.open()
        while Path(GIVEN["cable"]).exists():
            try:
                frame = source.read(0.1)
            except FrameTimeoutError:
                continue
            if frame.color_timestamp_us != color_us:
                color_us = frame.color_timestamp_us
                deliver(ob.OBStreamType.COLOR_STREAM, frame.color, frame.device_index, color_us)
            deliver(ob.OBStreamType.DEPTH_STREAM, frame.depth_mm, frame.device_index, frame.timestamp_us)
    except SourceLostError:
        return


class _Device:
    """The playback, whose sensors' calls hang where that is asked for."""

    def __init__(self, device):
        self._device = device

    def get_sensor(self, kind):
        return _Sensor(self._device.get_sensor(kind))

    def __getattr__(self, name):
        return getattr(self._device, name)


class _Sensor:
    def __init__(self, sensor):
        self._sensor = sensor

    def start(self, profile, receive):
        if "block" not in GIVEN:
            self._sensor.start(profile, receive)
            return
        _receivers[profile.get_type()] = profile, receive
        if len(_receivers) == 2:
            threading.Thread(target=_feed, daemon=True).start()

    def stop(self):
        if GIVEN.get("hangs") == "stop":
            time.sleep(3600)
        self._sensor.stop()

    def __getattr__(self, name):
        return getattr(self._sensor, name)
