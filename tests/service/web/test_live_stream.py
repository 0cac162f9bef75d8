"""The live stream: the newest frame, to everyone, as docs/4-integrate/stream.md shows it."""

import json
import re
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect

from engine import __version__
from engine.control.outputs import LatencySummary
from engine.core.breath import Breath
from engine.core.frames import BodyPosition, Lost, LostReason, Markers, Mover, RoomChange, TrainingProgress
from engine.core.gate_state import GateState, HoldReason
from engine.gating.supervision.checks import Check, CheckState
from engine.gating.supervision.patient_shift import Movement
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, ConditionState, HoldStage
from service.core.alarm_table import HOLD_TEXTS, hold_text
from service.core.schemas.live_messages import (
    LIVE_MESSAGE,
    LiveBreath,
    LiveBreathEvent,
    LiveBreathHold,
    LiveCondition,
    LiveLatency,
    LiveWindow,
    Sample,
)
from service.core.schemas.sessions import RecordingSource, Window
from service.engine_host.protocols import SessionPlan
from service.sessions.views.live import live_sample
from service.web.app import create_app
from tests.support.contract.schemas import Schema
from tests.support.repository import ROOT
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import WINDOW, act, make_calibration
from tests.support.service.fake_engine import FakeRunning

PARTS = (LiveWindow, LiveCondition, LiveBreath, LiveBreathEvent, LiveBreathHold, LiveLatency)
SCHEMA = Schema(json.loads((ROOT / "openapi" / "live.schema.json").read_text()))


@pytest.fixture
def plan():
    return SessionPlan(
        session_id="0" * 32,
        source=RecordingSource(kind="recording", path="a.oni"),
        recording=None,
        calibration=make_calibration(),
        window=Window.model_validate(WINDOW),
    )


def view_of(plan, **options):
    running = FakeRunning(plan)
    running.frame(**options)
    return running.latest


def message_of(view, plan):
    sample = live_sample(view, plan, is_stopping=False, is_simulated_beam=True)
    return json.loads(sample.model_dump_json())


def messages_of(socket):
    while True:
        message = socket.receive_json()
        SCHEMA.validate(message)
        yield message


def next_of(socket, kind):
    return next(one for one in messages_of(socket) if one["type"] == kind)


def test_the_stream_states_hello_and_is_idle_while_no_session_runs(client):
    with client.websocket_connect("/api/v1/live") as socket:
        hello = socket.receive_json()
        SCHEMA.validate(hello)
        assert hello.pop("sent_at").endswith("Z")
        assert hello == {
            "type": "hello",
            "schema": "tidegate.live/1",
            "version": __version__,
            "form": "full",
            "ping_s": 1.0,
        }
        first, second = socket.receive_json(), socket.receive_json()
    assert first["type"] == second["type"] == "idle"
    between = datetime.fromisoformat(second["sent_at"]) - datetime.fromisoformat(first["sent_at"])
    assert between.total_seconds() >= 0.25, "twice a second; a busy machine stamps the first one late"


def test_a_running_session_sends_its_newest_frame_once(client, session_id, running):
    with client.websocket_connect("/api/v1/live") as socket:
        next_of(socket, "idle")
        running.frame()
        first = next_of(socket, "sample")
        running.frame(whole_mm=2.0)
        second = next_of(socket, "sample")
    assert (first["frame_index"], first["whole_mm"]) == (0, 1.5)
    assert (second["frame_index"], second["whole_mm"]) == (1, 2.0)
    assert second["sequence"] == first["sequence"] + 1
    assert first["captured_at"] is None
    assert first["received_at"] < first["sent_at"]
    assert first["session_id"] == session_id
    assert first["is_simulated_beam"] is True
    assert first["age_ms"] > 0
    assert first["sent_at"].endswith("Z")


def test_a_frame_is_not_sent_twice(client, session_id, running):
    running.frame()
    with client.websocket_connect("/api/v1/live") as socket:
        assert next_of(socket, "sample")["frame_index"] == 0
        act(client, session_id, "stop")
        assert next(one for one in messages_of(socket) if one["type"] != "ping")["type"] == "idle"


def test_a_client_that_comes_late_gets_the_newest_frame_only(client, running):
    for _ in range(5):
        running.frame()
    with client.websocket_connect("/api/v1/live") as socket:
        assert next_of(socket, "sample")["frame_index"] == 4


def test_after_the_end_the_stream_is_idle_again(client, session_id, running):
    running.frame()
    with client.websocket_connect("/api/v1/live") as socket:
        next_of(socket, "sample")
        act(client, session_id, "stop")
        next_of(socket, "idle")


def test_a_sample_has_exactly_the_fields_of_the_documented_sample():
    text = (ROOT / "docs" / "4-integrate" / "stream.md").read_text()
    block = text[text.index('{"type": "sample"') :]
    block = block[: block.index("```")]
    shown = set(re.findall(r'"([a-z0-9_]+)":', re.sub(r"//.*", "", block)))
    assert {name for part in (Sample, *PARTS) for name in part.model_fields} <= shown


def test_what_could_not_be_measured_is_null(plan):
    message = message_of(view_of(plan, whole_mm=None), plan)
    SCHEMA.validate(message)
    names = ("signal_mm", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "residual_mm", "valid_share", "regions_mm")
    assert {name: message[name] for name in names} == dict.fromkeys(names)
    assert message["lost"] == {"reason": "marker_lost", "detail": "test", "moved": None, "moved_mm": None}
    assert message["roi_px"] is None


def test_a_couch_that_moved_is_named_with_how_far(plan):
    view = view_of(plan)
    doubt = Lost(reason=LostReason.CAMERA_MOVED, detail="test", moved=RoomChange(Mover.COUCH, 2.0))
    record = replace(view.record, measurement=replace(view.record.measurement, doubt=doubt))
    message = message_of(replace(view, record=record), plan)
    SCHEMA.validate(message)
    assert (message["state"], message["lost"]["moved"], message["lost"]["moved_mm"]) == ("measuring", "couch", 2.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_what_is_no_number_is_null(plan, value):
    message = message_of(view_of(plan, whole_mm=value), plan)
    SCHEMA.validate(message)
    assert message["whole_mm"] is None
    assert message["signal_mm"] is None


def test_regions_and_corners_go_out_in_order(plan):
    view = view_of(plan)
    corners = np.array([[10.0, 20.0], [30.0, 21.0], [31.0, 60.0], [9.0, 61.5]])
    object.__setattr__(view.record.measurement, "markers", Markers(centers_px=corners))
    message = message_of(view, plan)
    assert message["roi_px"] == corners.tolist()
    assert (len(message["regions_mm"]), len(message["regions_mm"][0])) == (14, 8)
    assert message["regions_mm"][0][:2] == [None, 1.5]
    edges = {name: value for name, value in WINDOW.items() if name != "dwell_ms"}
    assert edges.items() <= message["window"].items()
    (condition,) = message["window"].pop("conditions")
    assert message["window"] == edges | {"row": None, "column": None, "join": "and"}
    reported = {name: value for name, value in condition.items() if value is not None}
    assert reported == {
        "kind": "amplitude",
        "signal": "whole",
        "label": "whole",
        "unit": "mm",
        "lower": -1.0,
        "upper": 3.0,
        "hysteresis": 0.2,
        "is_inside": True,
        "seen_share": 0.98,
    }


def test_cells_that_the_camera_does_not_see_are_listed(plan):
    view = replace(view_of(plan), unseen_cells=((12, 0), (13, 7)))
    message = message_of(view, plan)
    SCHEMA.validate(message)
    assert message["unseen_cells"] == [[12, 0], [13, 7]]
    assert message_of(view_of(plan), plan)["unseen_cells"] == []
    assert message_of(view_of(plan, whole_mm=None), plan)["unseen_cells"] is None


def test_how_far_the_patient_has_moved_since_the_reference_is_reported(plan):
    view = view_of(plan)
    unknown = dict.fromkeys(("shift_mm", "turn_deg", "travel_mm", "height_mm", "tilt_deg", "roll_deg"))
    assert message_of(view, plan)["position"] == unknown
    lifted = BodyPosition(measured_us=7, height_mm=-1.234, tilt_deg=0.5, roll_deg=-0.25)
    measured = replace(view.record, measurement=replace(view.record.measurement, position=lifted))
    message = message_of(replace(view, record=measured, movement=Movement(shift_mm=2.345, turn_deg=0.7)), plan)
    SCHEMA.validate(message)
    assert message["position"] == {"shift_mm": 2.35, "turn_deg": 0.7, "height_mm": -1.23, "tilt_deg": 0.5} | {
        "roll_deg": -0.25,
        "travel_mm": None,
    }
    assert message_of(view_of(plan, whole_mm=None), plan)["position"] is None


def test_what_the_gate_rests_on_is_reported_with_the_time_of_each_check(plan):
    view = view_of(plan)
    assert message_of(view, plan)["checks"] == []
    now_us = view.record.measurement.timestamp_us
    states = (
        CheckState(Check.SURFACE, is_on=True, since_us=now_us - 2_500_000, was_on=True),
        CheckState(Check.COLOR, is_on=False, since_us=now_us - 700_000, was_on=True),
        CheckState(Check.CAMERA, is_on=False, since_us=now_us, was_on=False),
        CheckState(Check.MARKERS, is_on=True, since_us=now_us - 500_000, was_on=True),
    )
    message = message_of(replace(view, checks=states, movement=Movement(shift_mm=0.1, turn_deg=0.1)), plan)
    SCHEMA.validate(message)
    assert [(one["name"], one["state"], one["seconds"]) for one in message["checks"]] == [
        ("surface", "on", 2.5),
        ("color", "off", 0.7),
        ("camera", "never", 0.0),
        ("markers", "on", 0.5),
        ("clock", "off" if view.description.is_live else "never", None),
    ]
    assert message["checks"][2]["text"] == "too little of couch and floor is seen"


def test_breath_hold_and_holding_person_are_reported_with_the_reason_in_figures(plan):
    running = FakeRunning(plan)
    running.window = BreathHoldWindow(level=AmplitudeWindow(lower=-1.0, upper=3.0))
    running.conditions = (ConditionState(stage=HoldStage.SETTLING, holds=2),)
    running.breaths = (Breath(rate_per_min=14.0, note="the breath is held"),)
    running.operator_hold = "C. Nurse"
    running.frame()
    latency = LatencySummary(last_ms=120.0, p50_ms=30.0, p99_ms=90.0, max_ms=130.0, is_warned=True)
    message = message_of(replace(running.latest, detail="still for 0.4 s", latency=latency), plan)
    SCHEMA.validate(message)
    assert (message["breath"]["rate_per_min"], message["breath"]["note"]) == (14.0, "the breath is held")
    assert (message["breath_hold"]["stage"], message["breath_hold"]["count"]) == ("settling", 2)
    assert (message["operator_hold"], message["hold_detail"]) == ("C. Nurse", "still for 0.4 s")
    assert message["latency_ms"] == {"last": 120.0, "p50": 30.0, "p99": 90.0, "max": 130.0, "warned": True}
    assert (message["window"]["lower_mm"], message["window"]["conditions"][0]["kind"]) == (-1.0, "breath_hold")


def test_a_beam_that_is_on_is_not_held_for_any_reason(plan):
    running = FakeRunning(plan)
    running.gate = GateState.BEAM_ON
    running.frame(line_on=True)
    message = message_of(replace(running.latest, detail="an older reason"), plan)
    assert (message["hold_reason"], message["hold_text"], message["hold_detail"]) == (None, None, "")


def test_training_is_reported(plan):
    view = view_of(plan)
    progress = TrainingProgress(
        frames=10, cycles=1, seconds=3.0, share=0.3, note="breathe on", amplitude_mm=6.54321, shift_mm=float("nan")
    )
    object.__setattr__(view.record.measurement, "training", progress)
    assert message_of(view, plan)["training"] == {
        "frames": 10,
        "cycles": 1,
        "seconds": 3.0,
        "share": 0.3,
        "note": "breathe on",
        "amplitude_mm": 6.5432,
        "shift_mm": None,
    }


@pytest.mark.parametrize("state", list(GateState))
def test_every_gate_state_is_in_the_contract(plan, state):
    running = FakeRunning(plan)
    running.gate = state
    running.frame()
    message = message_of(running.latest, plan)
    SCHEMA.validate(message)
    assert message["gate"] == state.value


def test_every_reason_has_words():
    assert set(HOLD_TEXTS) == set(HoldReason)
    assert len(set(HOLD_TEXTS.values())) == len(HOLD_TEXTS)
    assert hold_text(None) is None


@pytest.mark.parametrize(
    ("origin", "is_welcome"),
    [
        (None, True),
        ("http://testserver", True),
        ("https://testserver", True),
        ("http://evil.example", False),
        ("http://testserver.evil.example", False),
        ("http://testserver:81", False),
        ("null", False),
        ("", False),
    ],
)
def test_only_our_own_page_may_open_the_stream(client, origin, is_welcome):
    headers = {} if origin is None else {"Origin": origin}
    if is_welcome:
        with client.websocket_connect("/api/v1/live", headers=headers) as socket:
            assert socket.receive_json()["type"] == "hello"
    else:
        with pytest.raises(WebSocketDisconnect) as refused, client.websocket_connect("/api/v1/live", headers=headers):
            pass
        assert refused.value.code == 1008


def test_a_host_that_is_not_ours_gets_no_stream(client):
    with (
        pytest.raises(WebSocketDisconnect) as refused,
        client.websocket_connect("/api/v1/live", headers={"Host": "evil.example"}),
    ):
        pass
    assert refused.value.code == 1008


def test_the_number_of_clients_is_bounded_and_places_come_free(settings, engine):
    few = settings.model_copy(update={"max_live_clients": 1})
    with PeopleClient(create_app(few, lambda _settings: engine)) as client:
        with client.websocket_connect("/api/v1/live") as first:
            assert first.receive_json()["type"] == "hello"
            with client.websocket_connect("/api/v1/live") as second, pytest.raises(WebSocketDisconnect) as refused:
                second.receive_json()
            assert refused.value.code == 1013
        with client.websocket_connect("/api/v1/live") as third:
            assert third.receive_json()["type"] == "hello"


def test_what_a_client_states_changes_nothing(client, running):
    with client.websocket_connect("/api/v1/live") as socket:
        for text in ('{"type": "arm"}', "x" * 1000):
            socket.send_text(text)
        socket.send_bytes(b"\x00")
        running.frame()
        assert next_of(socket, "sample")["frame_index"] == 0
    assert running.commands == []


def test_the_schema_in_the_repository_takes_every_kind_of_message(plan):
    for message in (
        {"type": "idle", "sent_at": "2026-11-21T03:00:00Z"},
        message_of(view_of(plan), plan),
    ):
        SCHEMA.validate(message)
        LIVE_MESSAGE.validate_python(message)
    assert not SCHEMA.is_valid({"type": "sample"})
    assert not SCHEMA.is_valid(message_of(view_of(plan), plan) | {"surprise": 1})
