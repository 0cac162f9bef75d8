"""Without a calibration: only a live camera, only its own registration, and everybody is notified."""

import threading

import pytest

from engine.calibration.camera_calibration import nominal_calibration
from engine.capture.source import RegisteredView, SourceDescription
from engine.core.errors import CommandRefusedError, FrameTimeoutError, InvalidValueError, SourceLostError
from service.core.errors import BoundError
from service.core.schemas.sessions import DeviceSource, Window
from service.core.settings.settings import Settings
from service.engine_host import local_engine
from service.engine_host.local_engine import LocalEngine
from service.engine_host.protocols import SessionPlan
from service.engine_host.site_limits.calibrations import WARNING
from service.storage.audit import SYSTEM
from tests.support.capture.fake_driver import FakeDriver, use
from tests.support.service.api_calls import WINDOW, act, audit_rows, make_calibration, upload

pytestmark = pytest.mark.alone

URL = "/api/v1/sessions"
SAID = {"calibration": "device registration", "calibration_warning": WARNING}


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    """An engine puts what it keeps into the data folder, which by default lies where one is."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def device_body(session_body):
    body = {name: value for name, value in session_body.items() if name != "calibration_id"}
    return body | {"source": {"kind": "device", "uri": "1d27/0601@1/2"}}


def test_a_camera_without_calibration_runs_on_its_own_registration_and_states_it(client, device_body, engine):
    session = client.post(URL, json=device_body).json()
    assert {name: session[name] for name in SAID} == SAID
    assert engine.probed == ["1d27/0601@1/2"]
    assert act(client, session["id"], "start").json()["calibration_warning"] == WARNING
    plan = engine.running.plan
    assert plan.calibration.is_device_registration
    assert plan.calibration.depth == plan.calibration.color
    assert client.get(f"{URL}/{session['id']}").json()["calibration"] == "device registration"
    for action in ("session.create", "session.start"):
        detail = audit_rows(client, action)[-1]["detail"]
        assert {name: detail[name] for name in SAID} == SAID
    assert audit_rows(client, "session.create")[-1]["detail"]["calibration_id"] == session["calibration_id"]


def test_the_nominal_geometry_is_kept_like_any_calibration(client, device_body):
    session = client.post(URL, json=device_body).json()
    stored = client.get(f"/api/v1/calibrations/{session['calibration_id']}").json()
    assert stored["camera"] == "device registration: Fake Xtion"
    assert stored["uploaded_by"] == SYSTEM
    assert stored["document"]["depth"]["fx"] == pytest.approx(571.7, abs=1.0)
    act(client, session["id"], "stop")
    assert client.post(URL, json=device_body).json()["calibration_id"] == session["calibration_id"]


def test_the_live_stream_states_it_first_and_in_every_sample(client, device_body, engine):
    session = client.post(URL, json=device_body).json()
    act(client, session["id"], "start")
    with client.websocket_connect("/api/v1/live") as socket:
        hello = socket.receive_json()
        assert {name: hello[name] for name in SAID} == SAID
        engine.running.frame()
        message = socket.receive_json()
        while message["type"] == "idle":
            message = socket.receive_json()
        assert message["calibration"] == "device registration"


def test_a_calibrated_session_states_that_too(client, session_body, engine):
    session = client.post(URL, json=session_body).json()
    assert (session["calibration"], session["calibration_warning"]) == ("uploaded", None)
    act(client, session["id"], "start")
    with client.websocket_connect("/api/v1/live") as socket:
        assert socket.receive_json()["calibration"] == "uploaded"
    assert engine.probed == []


def assert_refused(client, answer, word):
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (422, "invalid_value", "calibration_id")
    assert word in problem["bound"]
    assert client.get(URL).json()["items"] == []
    assert audit_rows(client, "session.create")[-1]["outcome"] == "refused"


@pytest.mark.parametrize("given", [{}, {"calibration_id": None}])
def test_a_recording_needs_a_calibration(client, session_body, engine, given):
    del session_body["calibration_id"]
    assert_refused(client, client.post(URL, json=session_body | given), "recording")
    assert engine.probed == []


def test_a_camera_that_does_not_register_needs_a_calibration(client, device_body, engine):
    engine.fail_with = BoundError("no", field="calibration_id", value="missing", bound="given: it cannot register")
    assert_refused(client, client.post(URL, json=device_body), "cannot register")


def test_a_camera_that_is_gone_is_reported(client, device_body, engine):
    engine.fail_with = SourceLostError("the OpenNI2 runtime sees no such camera")
    assert client.post(URL, json=device_body).status_code == 503
    assert client.get("/api/v1/calibrations").json()["items"][1:] == []


def test_an_open_camera_is_never_touched(client, device_body, session_id, engine):
    assert client.post(URL, json=device_body).status_code == 409
    assert engine.probed == []


def test_a_nominal_calibration_serves_no_recording(client, device_body, session_body):
    made = client.post(URL, json=device_body).json()
    act(client, made["id"], "stop")
    recording = {"kind": "recording", "path": "chest.oni"}
    answer = client.post(URL, json=device_body | {"calibration_id": made["calibration_id"], "source": recording})
    assert (answer.status_code, answer.json()["field"]) == (422, "calibration_id")
    assert client.post(URL, json=device_body | {"calibration_id": made["calibration_id"]}).status_code == 201


def test_uploading_a_calibration_under_that_name_is_refused(client):
    nominal = nominal_calibration("Fake Xtion", size_px=(640, 480), field_of_view_rad=(1.02, 0.797))
    answer = upload(client, nominal.to_json())
    assert (answer.status_code, answer.json()["field"]) == (422, "camera")


def test_a_slow_camera_does_not_block_the_database(client, device_body, engine):
    engine.while_probed = lambda: answers.append(upload(client, make_calibration("meanwhile").to_json()).status_code)
    answers = []
    assert client.post(URL, json=device_body).status_code == 201
    assert answers == [201]


def test_a_session_that_comes_in_between_wins(client, device_body, session_body, engine):
    engine.while_probed = lambda: answers.append(client.post(URL, json=session_body).status_code)
    answers = []
    assert client.post(URL, json=device_body).status_code == 409
    assert answers == [201]


@pytest.fixture
def camera(monkeypatch):
    """A camera of the runtime, as the adapter sees it; tests change what it says of itself."""
    said = {"angles": (1.02, 0.797)}

    def view(_uri):
        angles = said["angles"]
        return angles and RegisteredView(name="Xtion", size_px=(640, 480), field_of_view_rad=angles)

    said["driver"] = FakeDriver(["1d27/0601@1/2"], make=StillSource, view=view)
    use(monkeypatch, said["driver"])
    return said


def make_plan(calibration):
    source = DeviceSource(kind="device")
    return SessionPlan(
        session_id="0" * 32,
        source=source,
        recording=None,
        calibration=calibration,
        window=Window.model_validate(WINDOW),
    )


def test_the_engine_asks_the_camera_again_when_the_session_starts(camera, settings):
    adapter = LocalEngine(settings)
    calibration = adapter.built_in_calibration(None)
    for one in (calibration, make_calibration()):
        adapter.open(make_plan(one)).stop()
    assert [one["use_registration"] for one in camera["driver"].opened] == [True, False]
    camera["angles"] = (1.1, 0.8)
    with pytest.raises(SourceLostError, match="not the one whose own calibration"):
        adapter.open(make_plan(calibration))


def test_the_engine_refuses_cameras_it_cannot_use_uncalibrated(camera):
    adapter = LocalEngine(Settings())
    with pytest.raises(SourceLostError, match="no such camera"):
        adapter.built_in_calibration("elsewhere")
    camera["angles"] = None
    with pytest.raises(InvalidValueError) as refusal:
        adapter.built_in_calibration(None)
    assert refusal.value.field == "calibration_id"


class StillSource:
    """A camera that opens and then gives no frame."""

    def open(self):
        sizes = {"depth_size": (640, 480), "color_size": (640, 480)}
        return SourceDescription(kind="fake", name="fake", fps=30.0, is_live=True, **sizes)

    def read(self, timeout_s):
        threading.Event().wait(min(timeout_s, 0.02))
        raise FrameTimeoutError("none")

    def close(self):
        pass


def test_the_engine_leaves_a_running_session_s_camera_alone(camera, settings, monkeypatch):
    adapter = LocalEngine(settings)
    engine = adapter.open(make_plan(make_calibration()))
    try:
        with pytest.raises(CommandRefusedError, match="a session is running"):
            adapter.built_in_calibration(None)
    finally:
        engine.stop()
    assert adapter.built_in_calibration(None).is_device_registration


@pytest.mark.parametrize(
    ("may_gate", "is_nominal", "expected"), [(False, True, False), (False, False, True), (True, True, True)]
)
def test_the_gate_gets_whether_the_camera_was_calibrated(camera, settings, monkeypatch, may_gate, is_nominal, expected):
    taken = []

    class WatchedLoop(local_engine.EngineLoop):
        def __init__(self, **parts):
            taken.append(parts["limits"])
            super().__init__(**parts)

    monkeypatch.setattr(local_engine, "EngineLoop", WatchedLoop)
    adapter = LocalEngine(settings.model_copy(update={"beam_without_calibration": may_gate}))
    calibration = adapter.built_in_calibration(None) if is_nominal else make_calibration()
    adapter.open(make_plan(calibration)).stop()
    assert [limits.is_calibrated for limits in taken] == [expected]


def test_presence_reaches_the_loop(camera, settings, monkeypatch):
    heard = []
    monkeypatch.setattr(local_engine.EngineLoop, "note_presence", lambda _loop, operator: heard.append(operator))
    engine = LocalEngine(settings).open(make_plan(make_calibration()))
    engine.note_presence("Ada L.")
    engine.stop()
    assert heard == ["Ada L."]


class TestAStrictSite:
    @pytest.fixture
    def settings(self, settings: Settings) -> Settings:
        return settings.model_copy(update={"allow_device_registration": False})

    def test_it_refuses_what_was_not_measured(self, client, device_body, engine):
        assert_refused(client, client.post(URL, json=device_body), "this site")
        assert engine.probed == []
