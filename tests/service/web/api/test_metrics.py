"""What a monitoring system reads: true counts, present states, and nothing about a patient."""

from engine.core.gate_state import GateState, HoldReason
from tests.support.service.api_calls import act
from tests.support.service.metrics import read
from tests.support.waiting import eventually


def test_without_a_session_there_are_counts_and_no_states(client):
    found = read(client)
    assert found["tidegate_session_running",] == 0.0
    assert found["tidegate_frames_total", "measuring"] == 0.0
    assert not [name for name, *_ in found if name.endswith("_created")]
    assert not [name for name, *_ in found if name in {"tidegate_line_on", "tidegate_fps", "tidegate_gate_state"}]


def test_a_running_session_is_counted_and_reported(client, session_id, running):
    running.camera_ms = 20.0
    running.frame()
    running.frame(whole_mm=None)
    running.transition(GateState.BEAM_ON)
    running.transition(GateState.HOLD, HoldReason.OUTSIDE_WINDOW)
    running.transition(GateState.BEAM_ON)
    running.frame(line_on=True)
    eventually(lambda: read(client)["tidegate_frames_total", "measuring"] == 2.0)
    eventually(lambda: read(client)["tidegate_gate_transitions_total", "", "beam_on"] == 2.0)
    found = read(client)
    assert found["tidegate_frames_total", "lost"] == 1.0
    assert found["tidegate_line_on_frames_total",] == 1.0
    assert found["tidegate_gate_transitions_total", "hold", "outside_window"] == 1.0
    assert (found["tidegate_gate_state", "beam_on"], found["tidegate_gate_state", "hold"]) == (1.0, 0.0)
    assert (found["tidegate_armed",], found["tidegate_line_on",]) == (1.0, 1.0)
    assert found["tidegate_fps",] == 29.97
    assert found["tidegate_queue_size", "samples"] == 0.0
    assert found["tidegate_latency_recent_seconds", "0.99"] == 0.009
    assert found["tidegate_latency_recent_seconds", "1"] == 0.031
    assert found["tidegate_latency_seconds_count",] == 3.0
    assert (found["tidegate_latency_seconds_bucket", "0.02"], found["tidegate_latency_seconds_bucket", "0.033"]) == (
        0.0,
        3.0,
    )


def test_counts_outlive_a_session_and_states_do_not(client, session_id, running):
    running.frame()
    act(client, session_id, "stop")
    found = read(client)
    assert found["tidegate_frames_total", "measuring"] == 1.0
    assert ("tidegate_line_on",) not in found


def test_nothing_about_a_patient_is_revealed(client, session_id, running, session_body):
    running.frame()
    act(client, session_id, "hold", operator="A. Therapist")
    text = client.get("/metrics").text
    for name in ("patient_reference", "plan_id", "fraction_id", "operator", "calibration_id"):
        assert session_body[name] not in text
    assert session_id not in text
    assert "chest.oni" not in text
