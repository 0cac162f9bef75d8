"""A calibration belongs to the camera with its serial number: another one is refused, or warned of and audited."""

from dataclasses import replace

import pytest

from engine.calibration.camera_calibration import nominal_calibration
from engine.capture.reconnecting import CheckedSource
from engine.capture.source import SourceDescription
from engine.core.errors import CameraMismatchError
from service.core.settings.settings import Settings
from service.engine_host.site_limits.calibrations import checked_camera, serial_warning
from tests.support.service.api_calls import act, audit_rows, make_calibration
from tests.support.service.fake_engine import FakeRunning

CAMERA = SourceDescription(
    kind="openni", name="Xtion", depth_size=(640, 480), color_size=(640, 480), fps=30.0, is_live=True, serial="A1"
)
OURS = replace(make_calibration(), serial="A1")
NOMINAL = nominal_calibration("Fake Xtion", size_px=(640, 480), field_of_view_rad=(1.02, 0.797))
CLINICAL = Settings().model_copy(update={"mode": "clinical"})


class Camera:
    """A camera that opens; ``closed`` counts."""

    is_free = True

    def __init__(self, described: SourceDescription) -> None:
        self.described, self.closed = described, 0

    def open(self) -> SourceDescription:
        return self.described

    def close(self) -> None:
        self.closed += 1


@pytest.mark.parametrize(
    ("calibration", "camera", "code"),
    [
        (OURS, CAMERA, None),
        (OURS, replace(CAMERA, serial="B2"), "camera_mismatch"),
        (OURS, replace(CAMERA, serial=""), "camera_mismatch"),
        (make_calibration(), CAMERA, "serial_unknown"),
        (make_calibration(), replace(CAMERA, serial=""), "serial_unknown"),
        (OURS, replace(CAMERA, serial="", is_live=False), None),
        (make_calibration(), replace(CAMERA, serial="", is_live=False), None),
        (make_calibration(), replace(CAMERA, is_live=False), None),
        (OURS, replace(CAMERA, is_live=False), None),
        (OURS, replace(CAMERA, serial="B2", is_live=False), "camera_mismatch"),
        (NOMINAL, CAMERA, None),
    ],
)
def test_a_live_camera_is_compared_with_its_calibration(calibration, camera, code):
    found = serial_warning(calibration, camera)
    assert (None if found is None else found.code) == code
    if found is not None:
        assert (camera.serial or "none") in found.text


def test_clinical_mode_refuses_another_camera_and_closes_it():
    camera = Camera(replace(CAMERA, serial="B2"))
    with pytest.raises(CameraMismatchError, match="serial number A1, and this one has B2"):
        checked_camera(camera, OURS, CLINICAL).open()
    assert camera.closed == 1


def test_clinical_mode_opens_the_calibrated_camera():
    camera = Camera(replace(CAMERA, serial="A1"))
    source = checked_camera(camera, OURS, CLINICAL)
    assert isinstance(source, CheckedSource)
    assert source.open().serial == "A1"
    assert camera.closed == 0


@pytest.mark.parametrize(("calibration", "serial"), [(make_calibration(), "A1"), (make_calibration(), ""), (OURS, "")])
def test_clinical_mode_refuses_a_camera_that_cannot_be_compared(calibration, serial):
    camera = Camera(replace(CAMERA, serial=serial))
    with pytest.raises(CameraMismatchError, match="serial number"):
        checked_camera(camera, calibration, CLINICAL).open()
    assert camera.closed == 1


def test_other_modes_open_every_camera():
    camera = Camera(replace(CAMERA, serial="B2"))
    assert checked_camera(camera, OURS, Settings()) is camera


@pytest.fixture
def opened(monkeypatch):
    """Let the fake engine open this camera."""

    def use(camera: SourceDescription) -> None:
        status = FakeRunning.status
        monkeypatch.setattr(FakeRunning, "status", property(lambda self: replace(status.fget(self), source=camera)))

    return use


def test_a_camera_that_was_not_compared_is_shown_and_audited(client, session_id, opened):
    opened(CAMERA)
    act(client, session_id, "start")
    shown = client.get(f"/api/v1/sessions/{session_id}").json()["camera"]
    assert (shown["name"], shown["serial"], shown["code"]) == ("Xtion", "A1", "serial_unknown")
    (row,) = audit_rows(client, "session.camera")
    assert row["detail"] == {**shown, "calibration_serial": None}


def test_a_recording_needs_no_serial_number(client, session_id, opened):
    opened(replace(CAMERA, is_live=False, serial=""))
    act(client, session_id, "start")
    shown = client.get(f"/api/v1/sessions/{session_id}").json()["camera"]
    assert (shown["serial"], shown["code"], shown["warning"]) == (None, None, None)
    assert audit_rows(client, "session.camera") == []
