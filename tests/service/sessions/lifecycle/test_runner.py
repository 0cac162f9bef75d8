"""The running session: started, asked, watched, stopped."""

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Thread
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from engine.core.commands import Acknowledge, ActivateModel, Arm, Disarm, Retrain, SetReference
from engine.core.errors import RuntimeMissingError, SourceLostError
from engine.core.gate_state import GateState, HoldReason
from engine.motion.learning.model_file import save_model
from service.core.errors import SessionStateError
from service.sessions.lifecycle import commands
from service.sessions.lifecycle.writer import SessionWriter
from service.storage.audit.log import AuditLog
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, make_session_body, upload
from tests.support.service.fake_engine import REFUSED, make_model
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]


def detail_of(client, session_id):
    return client.get(f"/api/v1/sessions/{session_id}").json()


@pytest.mark.parametrize(
    ("action", "kind"),
    [
        ("arm", Arm),
        ("disarm", Disarm),
        ("reference", SetReference),
        ("acknowledge", Acknowledge),
        ("models/retrain", Retrain),
    ],
)
def test_each_call_asks_the_engine_for_its_command_in_the_operator_s_name(client, session_id, running, action, kind):
    answer = act(client, session_id, action, operator="B. Physicist")
    assert answer.status_code in {200, 202}
    assert [type(command) for command in running.commands] == [kind]
    assert running.commands[0].operator == "B. Physicist"
    row = next(row for row in audit_rows(client) if row["actor"] == "B. Physicist" and row["outcome"] == "done")
    assert row["session_id"] == session_id


@pytest.mark.parametrize("action", ["arm", "reference", "acknowledge", "models/retrain"])
def test_what_the_engine_refuses_is_a_conflict_with_its_reason(client, session_id, running, action):
    running.refuse_with = REFUSED
    answer = act(client, session_id, action)
    assert (answer.status_code, answer.json()["code"]) == (409, "command_refused")
    assert answer.json()["detail"] == "no model yet"
    assert audit_rows(client)[-1]["outcome"] == "refused"


def test_a_silent_engine_gives_a_time_out_and_the_arming_is_withdrawn(client, session_id, running):
    running.is_silent = True
    futures = []
    submit = running.submit
    running.submit = lambda command, **when: futures.append(submit(command, **when)) or futures[-1]
    answer = act(client, session_id, "arm")
    assert (answer.status_code, answer.json()["code"]) == (503, "engine_timeout")
    assert futures[0].cancelled()


@pytest.mark.parametrize("action", ["arm", "release", "reference", "acknowledge"])
def test_what_waited_too_long_since_its_call_arrived_is_refused_before_it_is_written_down(
    client, session_id, running, monkeypatch, action
):
    monkeypatch.setattr(f"{commands.__name__}.request_time_ns", lambda: time.monotonic_ns() - 2 * commands.MAX_WAIT_NS)
    answer = act(client, session_id, action)
    assert (answer.status_code, answer.json()["code"]) == (409, "command_refused")
    assert running.commands == []
    assert [row["outcome"] for row in audit_rows(client, f"session.{action}")] == ["refused"]


@pytest.mark.parametrize("action", ["disarm", "hold"])
def test_what_takes_the_beam_away_is_never_too_late_and_minds_no_query(
    client, session_id, running, monkeypatch, action
):
    monkeypatch.setattr(f"{commands.__name__}.request_time_ns", lambda: time.monotonic_ns() - 60 * commands.MAX_WAIT_NS)
    answer = client.post(f"/api/v1/sessions/{session_id}/{action}?_=1", json={"operator": "A. Therapist"})
    assert answer.status_code == 200
    assert len(running.commands) == 1


@pytest.mark.parametrize("action", ["disarm", "hold"])
def test_taking_permission_away_withdraws_all_earlier_calls_before_the_engine_is_commanded(
    client, session_id, running, action
):
    """As young as the telling: an arming that arrived after this call, and looked before it was reported, is older."""
    assert act(client, session_id, action).status_code == 200
    assert running.asked_ns == [None]


def test_an_arming_is_as_old_as_its_call_not_as_its_row_in_the_audit(client, session_id, running, monkeypatch):
    seen = []
    write = AuditLog.write
    monkeypatch.setattr(AuditLog, "write", lambda *a, **k: (seen.append(time.monotonic_ns()), write(*a, **k))[1])
    before_ns = time.monotonic_ns()
    assert act(client, session_id, "arm").status_code == 200
    assert before_ns <= running.asked_ns[0] < seen[0]


@pytest.mark.parametrize("body", [{"operator": ""}, {"operator": 3}, {"operator": "x", "force": True}, [], "x"])
def test_nothing_but_who_asks_is_stated(client, session_id, running, body):
    answer = client.post(f"/api/v1/sessions/{session_id}/arm", json=body)
    assert answer.status_code == 422
    assert running.commands == []
    row = audit_rows(client, "session.arm")[-1]
    assert (row["outcome"], row["session_id"]) == ("refused", session_id)


@pytest.mark.parametrize("action", ["arm", "disarm", "reference", "acknowledge", "models/retrain"])
def test_a_session_that_does_not_run_cannot_be_asked(client, session_id, action):
    answer = act(client, session_id, action)
    assert (answer.status_code, answer.json()["code"]) == (409, "session_state")


def test_a_session_starts_once(client, session_id, running, engine):
    answer = act(client, session_id, "start")
    assert (answer.status_code, answer.json()["code"]) == (409, "session_state")
    assert len(engine.opened) == 1


def test_a_stopped_session_neither_starts_nor_stops_again(client, session_id, running):
    assert act(client, session_id, "stop").json()["status"] == "stopped"
    assert act(client, session_id, "start").status_code == 409
    assert act(client, session_id, "stop").status_code == 409


def test_the_engine_gets_the_stored_plan(client, session_id, running, settings, calibration_text):
    plan = running.plan
    assert plan.session_id == session_id
    assert plan.recording == settings.recordings_dirs[0] / "chest.oni"
    assert plan.calibration.to_json() == calibration_text
    assert (plan.window.lower_mm, plan.window.upper_mm) == (-1.0, 3.0)


@pytest.mark.parametrize(
    ("error", "status"), [(SourceLostError("no camera"), 503), (RuntimeMissingError("no runtime"), 503)]
)
def test_an_engine_that_cannot_be_made_fails_the_session(client, session_id, engine, error, status):
    engine.fail_with = error
    answer = act(client, session_id, "start")
    assert (answer.status_code, answer.json()["detail"]) == (status, str(error))
    assert detail_of(client, session_id)["status"] == "failed"
    assert audit_rows(client, "session.start")[-1]["outcome"] == "refused"


def test_a_source_that_does_not_open_fails_the_session_and_frees_the_room(client, session_id, engine, session_body):
    engine.broken_source = "chest.oni is no recording"
    answer = act(client, session_id, "start")
    assert (answer.status_code, answer.json()["code"]) == (422, "source_unusable")
    assert "no recording" in answer.json()["detail"]
    assert detail_of(client, session_id)["status"] == "failed"
    assert client.post("/api/v1/sessions", json=session_body).status_code == 201


def test_a_recording_that_is_over_ends_the_session(client, session_id, running):
    running.frame()
    running.end()
    eventually(lambda: detail_of(client, session_id)["status"] == "ended")
    detail = detail_of(client, session_id)
    assert detail["ended_at"] is not None
    # The row says so a moment before the room is free again.
    eventually(lambda: detail_of(client, session_id)["gate"] is None)
    assert audit_rows(client, "session.close")[-1]["detail"]["summary"]["frames"] == 1


def test_an_engine_that_fails_states_why_in_the_session(client, session_id, running):
    running.end(error="the camera is gone")
    eventually(lambda: detail_of(client, session_id)["status"] == "failed")
    assert detail_of(client, session_id)["status_detail"] == "the camera is gone"


def test_a_running_session_shows_its_gate_and_figures(client, session_id, running):
    running.frame(whole_mm=None)
    running.transition(GateState.HOLD, HoldReason.DWELL)
    running.frame()
    running.transition(GateState.BEAM_ON)
    for _ in range(2):
        running.frame(line_on=True)
    eventually(lambda: detail_of(client, session_id)["summary"]["frames"] == 4)
    detail = detail_of(client, session_id)
    # The transition may be recorded after the frames.
    assert detail["gate"] | {"state_since": None} == {
        "state": "beam_on",
        "state_since": None,
        "is_armed": True,
        "hold_reason": None,
        "hold_text": None,
        "hold_detail": "",
        "operator_hold": None,
        "operator_holds": [],
        "armed_by": None,
        "armed_at": None,
        "line_on": True,
    }
    summary = detail["summary"]
    assert (summary["lost"], summary["missed_frames"], summary["transitions"]) == (1, 0, 2)
    assert summary["duty_cycle"] == pytest.approx(2 / 3)
    assert summary["latency"] == {"p50_ms": 5.0, "p99_ms": 9.0, "max_ms": 31.0}, "as the engine counts them"
    act(client, session_id, "stop")
    closed = detail_of(client, session_id)["summary"]
    assert closed["latency"]["p50_ms"] == pytest.approx(5.002), "over all that was stored"
    assert closed["latency"]["p99_ms"] == pytest.approx(5.003)
    assert closed.pop("transitions") == summary.pop("transitions") + 1
    assert closed.pop("elapsed_s") > summary.pop("elapsed_s")
    assert closed.pop("holds")[:1] == summary.pop("holds"), "with the end of the engine beside them"
    assert closed | {"latency": None} == summary | {"latency": None}, "counted as it ran, and read from the samples"


def test_the_samples_are_exported_with_nothing_where_nothing_was_measured(client, session_id, running):
    running.frame()
    running.frame(whole_mm=None)
    act(client, session_id, "stop")
    answer = client.get(f"/api/v1/sessions/{session_id}/samples")
    assert answer.headers["content-type"].startswith("text/csv")
    assert answer.text.splitlines() == [
        "frame_index,timestamp_us,state,whole_mm,thorax_mm,abdomen_mm,volume_l,gate,hold_reason,received_ns,decided_ns,asserted_ns,captured_ns,phase_percent",
        "0,0,measuring,1.5,1.1,1.9,0.21,disarmed,disarmed,1000000000,1004000000,1005000000,,",
        "1,33370,lost,,,,,disarmed,disarmed,1033370000,1037370000,1038371000,,",
    ]


def test_a_long_export_comes_in_pieces_and_loses_no_row(client, session_id, running):
    for _ in range(850):
        running.frame()
    eventually(running.samples.empty)
    for _ in range(850):
        running.frame()
    act(client, session_id, "stop")
    rows = client.get(f"/api/v1/sessions/{session_id}/samples").text.splitlines()[1:]
    assert [int(row.partition(",")[0]) for row in rows] == list(range(1700))


def test_the_picture_is_the_newest_colour_frame(client, session_id, running):
    assert client.get(f"/api/v1/sessions/{session_id}/picture").json()["code"] == "picture_missing"
    running.frame()
    running.frame()
    color = np.zeros((48, 64, 3), dtype=np.uint8)
    color[..., 0] = 250
    object.__setattr__(running.latest, "color", color)
    answer = client.get(f"/api/v1/sessions/{session_id}/picture")
    assert (answer.headers["X-Frame-Index"], answer.headers["content-type"]) == ("1", "image/jpeg")
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert picture.shape == (48, 64, 3)
    assert abs(int(picture[20, 20, 0]) - 250) < 5
    assert picture[20, 20, 2] < 5


def test_transitions_are_listed_oldest_first_page_by_page(client, session_id, running):
    for state in (GateState.HOLD, GateState.DWELL, GateState.BEAM_ON, GateState.HOLD, GateState.FAULT):
        running.transition(state, HoldReason.OUTSIDE_WINDOW)
    url = f"/api/v1/sessions/{session_id}/transitions"
    eventually(lambda: len(client.get(url).json()["items"]) == 5)
    first = client.get(url, params={"limit": 3}).json()
    second = client.get(url, params={"limit": 3, "cursor": first["next_cursor"]}).json()
    items = first["items"] + second["items"]
    assert [item["to_state"] for item in items] == ["hold", "dwell", "beam_on", "hold", "fault"]
    assert [item["from_state"] for item in items] == ["disarmed", "hold", "dwell", "beam_on", "hold"]
    assert items[0]["asserted_ns"] == 2_000_000_003
    assert second["next_cursor"] is None


def test_a_learned_model_is_kept_listed_and_activated(client, session_id, running):
    running.model = make_model(1)
    url = f"/api/v1/sessions/{session_id}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1)
    running.model = make_model(2)
    eventually(lambda: len(client.get(url).json()["items"]) == 2)
    newest, first = client.get(url).json()["items"]
    assert (newest["number"], newest["is_active"], first["number"], first["is_active"]) == (2, True, 1, False)
    assert client.get(f"/api/v1/models/{first['id']}").json() == first
    share = client.get(f"/api/v1/models/{first['id']}/spectrum").json()["share"]
    assert share == pytest.approx([0.98, 0.015, 0.005])
    answer = client.post(f"/api/v1/models/{first['id']}/activate", json={"operator": "A. Physicist"})
    assert answer.status_code == 200
    (command,) = running.commands
    assert isinstance(command, ActivateModel)
    assert np.array_equal(command.model.components, make_model(1).components)
    running.model = command.model
    eventually(lambda: detail_of(client, session_id)["active_model_id"] == first["id"])
    assert len(client.get(url).json()["items"]) == 2
    used = [row["detail"]["number"] for row in audit_rows(client, "model.in_use")]
    assert used == [1, 2, 1]


def test_a_model_whose_file_was_changed_is_not_activated(client, session_id, running, settings):
    running.model = make_model(1)
    url = f"/api/v1/sessions/{session_id}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1)
    (model,) = client.get(url).json()["items"]
    save_model(make_model(2), settings.data_dir / "models" / f"{model['sha256']}.npz")
    answer = client.post(f"/api/v1/models/{model['id']}/activate", json={"operator": "me"})
    assert (answer.status_code, answer.json()["code"]) == (409, "model_invalid")
    assert running.commands == []


def test_an_unknown_model_is_not_found(client):
    for path in ("", "/spectrum"):
        assert client.get(f"/api/v1/models/{'0' * 32}{path}").status_code == 404
    assert client.post(f"/api/v1/models/{'0' * 32}/activate", json={"operator": "me"}).status_code == 404


def test_the_service_stops_the_engine_on_its_way_out_and_closes_the_session(settings, engine, calibration_text):
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        calibration_id = upload(client, calibration_text).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        act(client, session_id, "start")
        engine.running.frame()
    assert engine.running.status.is_over
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        detail = detail_of(client, session_id)
        assert (detail["status"], detail["summary"]["frames"]) == ("stopped", 1)
        assert client.get("/api/v1/audit/verify").json()["is_intact"]


class StartsOnceLetGo:
    """The lock of coming and going, whose first leaving lets a start in before anything else."""

    def __init__(self, lock, start) -> None:
        self._lock, self._start = lock, start

    def __enter__(self):
        self._lock.acquire()

    def __exit__(self, *exception):
        self._lock.release()
        start, self._start = self._start, lambda: None
        start()


def test_a_stop_that_races_a_start_leaves_no_session_running(client, session_id, engine):
    runner, started = client.app.state.services.runner, []

    def start():
        with suppress(SessionStateError):
            started.append(runner.start(session_id, "A. Therapist").status)

    runner._session_lock = StartsOnceLetGo(runner._session_lock, start)
    assert runner.stop(session_id, "A. Therapist").status == "stopped"
    assert started == [], "it came first, or not at all"
    assert detail_of(client, session_id)["status"] == "stopped"


class Beginning(Thread):
    """A writer that looks begun before it is: a thread has its number before it may be waited for."""

    ident = 1


@pytest.mark.parametrize("is_begun", [True, False], ids=["begun at last", "never begun"])
def test_a_stop_waits_for_a_writer_that_is_about_to_begin(client, is_begun):
    runner, written = client.app.state.services.runner, []
    writer = Beginning(target=lambda: written.append("the end"))
    with ThreadPoolExecutor(1) as pool:
        with runner._session_lock:
            awaited = pool.submit(runner._await_end, SimpleNamespace(writer=writer))
            if is_begun:
                writer.start()
        awaited.result(PATIENCE_S)
    assert written == ["the end"] * is_begun


@pytest.mark.parametrize("error", [AssertionError("inside"), EOFError()], ids=repr)
def test_a_start_that_breaks_on_the_way_leaves_a_failed_session_and_room_for_another(
    client, session_id, session_body, engine, error
):
    engine.fail_with = error
    with pytest.raises(type(error)):
        act(client, session_id, "start")
    reported = detail_of(client, session_id)
    assert (reported["status"], reported["status_detail"]) == (
        "failed",
        f"the engine could not be opened ({type(error).__name__})",
    )
    engine.fail_with = None
    another = client.post("/api/v1/sessions", json=session_body).json()["id"]
    assert act(client, another, "start").status_code == 200


def test_a_session_whose_writer_cannot_begin_is_stopped_and_leaves_the_room(client, session_id, engine, monkeypatch):
    def start(_writer):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(SessionWriter, "start", start)
    with pytest.raises(RuntimeError):
        act(client, session_id, "start")
    assert engine.running.status.is_over
    assert detail_of(client, session_id)["status"] == "failed"
    assert client.app.state.services.runner.running_camera() is None
