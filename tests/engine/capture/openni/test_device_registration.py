"""A camera's own registration: switched on or refused, never assumed; the runtime's part is played by a fake one."""

# ruff: noqa: N802 - the names are those of the C API

import ctypes
import math

import numpy as np
import pytest

from engine.calibration.device_registration import built_in_calibration
from engine.capture.openni import c_api as c, device as _openni_device
from engine.capture.openni.device import OpenNiDevice
from engine.capture.openni.source import OpenNiSource
from engine.core.clock import MonotonicClock
from engine.core.errors import CalibrationError, RecordingError, SourceLostError
from tests.support.capture.oni_recordings import write_recording

pytestmark = pytest.mark.alone

URI = "1d27/0601@1/2"


class FakeRuntime:
    """A camera of OpenNI2, as far as registration goes; ``device_properties`` is what was set on it, in order."""

    def __init__(self) -> None:
        self.can_register = True
        self.obeys = True
        self.angles = {c.STREAM_HORIZONTAL_FOV: 1.0226, c.STREAM_VERTICAL_FOV: 0.7966}
        self.device_properties: list[tuple[int, int]] = []
        self.created: list[int] = []
        self.destroyed = 0
        self.is_open = False
        self.is_mirrored = {10 + c.SENSOR_DEPTH: 0, 10 + c.SENSOR_COLOR: 0}

    def oniDeviceOpen(self, _uri, handle):
        handle._obj.value = 1
        self.is_open = True
        return c.STATUS_OK

    def oniDeviceClose(self, _handle):
        self.is_open = False

    def oniDeviceGetInfo(self, _handle, info):
        info._obj.name = b"PS1080"

    def oniRegisterDeviceCallbacks(self, *_args):
        return c.STATUS_OK

    def oniDeviceIsImageRegistrationModeSupported(self, _handle, mode):
        return int(self.can_register or mode == c.REGISTRATION_OFF)

    def oniDeviceSetProperty(self, _handle, name, value, _size):
        if not self.obeys:
            return 1
        self.device_properties.append((name, value._obj.value))
        return c.STATUS_OK

    def oniDeviceCreateStream(self, _handle, sensor, handle):
        handle._obj.value = 10 + sensor
        self.created.append(sensor)
        return c.STATUS_OK

    def oniStreamDestroy(self, _handle):
        self.destroyed += 1

    def oniStreamGetProperty(self, handle, name, value, _size):
        if name == c.STREAM_MIRRORING:
            value._obj.value = self.is_mirrored[handle.value]
            return c.STATUS_OK
        if name not in self.angles:
            return 1
        value._obj.value = self.angles[name]
        return c.STATUS_OK

    def oniDeviceGetSensorInfo(self, _handle, sensor):
        pixel_format = c.PIXEL_RGB888 if sensor == c.SENSOR_COLOR else c.PIXEL_DEPTH_1_MM
        modes = (c.VideoMode * 1)(c.VideoMode(pixel_format, 640, 480, 30))
        return ctypes.pointer(c.SensorInfo(sensor, 1, modes))

    def oniStreamSetProperty(self, *_args):
        return c.STATUS_OK

    def last_error(self):
        return "it will not"


@pytest.fixture
def runtime(monkeypatch):
    fake = FakeRuntime()
    monkeypatch.setattr(c, "runtime", lambda: fake)
    monkeypatch.setattr(_openni_device, "_listeners", _openni_device._Listeners())
    return fake


def create_streams(*, use_registration: bool) -> None:
    device = OpenNiDevice(URI, is_file=False)
    device.create_streams(((640, 480), (640, 480)), 30, use_registration=use_registration)


@pytest.mark.parametrize(("is_wanted", "mode"), [(True, 1), (False, 0)])
def test_registration_is_set_as_asked_before_any_stream(runtime, is_wanted, mode):
    create_streams(use_registration=is_wanted)
    assert runtime.device_properties == [(c.DEVICE_IMAGE_REGISTRATION, mode)]
    assert runtime.created == [c.SENSOR_DEPTH, c.SENSOR_COLOR]


@pytest.mark.parametrize("is_wanted", [True, False])
def test_a_device_that_does_not_obey_is_not_used(runtime, is_wanted):
    """Depth that lies in another view than everybody thinks would be measured beside the markers."""
    runtime.obeys = False
    with pytest.raises(SourceLostError, match=r"does not switch its registration (on|off): it will not"):
        create_streams(use_registration=is_wanted)
    assert runtime.created == []


def test_a_device_that_cannot_register_is_refused_when_asked_to_and_used_when_not(runtime):
    runtime.can_register = False
    with pytest.raises(SourceLostError, match="PS1080 cannot register depth to colour: a calibration is needed"):
        create_streams(use_registration=True)
    create_streams(use_registration=False)
    assert runtime.device_properties == []
    assert built_in_calibration(URI) is None


@pytest.mark.parametrize(("sensor", "kind"), [(c.SENSOR_DEPTH, "depth"), (c.SENSOR_COLOR, "colour")])
def test_a_device_that_goes_on_mirroring_is_not_used(runtime, sensor, kind):
    """The patient's right side would be taken for the left."""
    runtime.is_mirrored[10 + sensor] = 1
    with pytest.raises(SourceLostError, match=f"PS1080 does not stop mirroring its {kind} pictures"):
        create_streams(use_registration=False)


def test_the_nominal_geometry_is_that_of_the_colour_camera(runtime):
    calibration = built_in_calibration(URI)
    assert calibration.camera == "device registration: PS1080"
    assert calibration.is_device_registration
    assert calibration.depth == calibration.color
    assert (calibration.depth.cx, calibration.depth.cy) == (319.5, 239.5)
    # The outer edges of the picture are half a pixel beyond the outer centres.
    edge = calibration.depth.rays(np.array([[-0.5, 239.5], [639.5, 239.5]]))[:, 0]
    assert math.atan(edge[1]) - math.atan(edge[0]) == pytest.approx(1.0226, abs=1e-5)
    assert not calibration.color_from_depth.translation_mm.any()
    assert runtime.created == [c.SENSOR_COLOR]
    assert (runtime.destroyed, runtime.is_open, runtime.device_properties) == (1, False, [])


@pytest.mark.parametrize("angle", [0.0, 0.1, 3.2, math.nan, math.inf])
def test_a_field_of_view_that_cannot_be_is_refused(runtime, angle):
    runtime.angles[c.STREAM_VERTICAL_FOV] = angle
    with pytest.raises(CalibrationError) as refusal:
        built_in_calibration(URI)
    assert refusal.value.field == "vertical field of view of PS1080"
    assert not runtime.is_open


def test_a_device_that_does_not_tell_its_view_is_refused(runtime):
    runtime.angles = {}
    with pytest.raises(SourceLostError, match="does not report its field of view"):
        built_in_calibration(URI)
    assert (runtime.destroyed, runtime.is_open) == (1, False)


def test_the_real_runtime_registers_no_recording(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=3)
    with pytest.raises(RecordingError, match="a recording cannot register depth to colour"):
        OpenNiSource(path, clock=MonotonicClock(), use_device_registration=True).open()


def test_the_real_runtime_sees_no_camera_of_that_name():
    with pytest.raises(SourceLostError, match="cannot be opened by OpenNI2"):
        built_in_calibration("1d27/0600@99/99")
