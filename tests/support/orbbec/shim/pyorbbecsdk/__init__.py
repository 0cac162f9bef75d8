"""The real ``pyorbbecsdk``, whose context has one device: the SDK's own playback of a recording.

``VIRTUAL_ORBBEC`` is JSON: ``bag`` the recording, ``cable`` a file that is there while the camera is plugged in,
``hangs`` a call that never returns.
"""

import importlib
import json
import os
import sys
import time
from pathlib import Path

HERE = str(Path(__file__).parents[1])
GIVEN = json.loads(os.environ["VIRTUAL_ORBBEC"])


def _real():
    """Import the wheel's package in place of this one."""
    path, mine = list(sys.path), sys.modules.pop(__name__)
    sys.path[:] = [one for one in path if one != HERE]
    try:
        return importlib.import_module(__name__)
    finally:
        sys.path[:] = path
        sys.modules[__name__] = mine


ob = _real()
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

    def stop(self):
        if GIVEN.get("hangs") == "stop":
            time.sleep(3600)
        self._sensor.stop()

    def __getattr__(self, name):
        return getattr(self._sensor, name)
