"""What people ask of a gate that runs: hold, release, presence, correct the baseline; each audited but presence."""

from dataclasses import replace

import pytest

from engine.core.breath import Breath, SignalChoice
from engine.core.commands import CorrectBaseline, HoldBeam, ReleaseBeam
from engine.core.errors import InvalidValueError
from engine.gating.windows import AmplitudeWindow
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.fake_engine import REFUSED
from tests.support.waiting import eventually

SEEN = {"operator": "B. Physicist", "by_mm": 1.5, "drift_mm": 1.6}
ACTION = "session.baseline_correction"


def correct(client, session_id, **changes):
    body = {name: value for name, value in (SEEN | changes).items() if value is not None}
    return client.post(f"/api/v1/sessions/{session_id}/baseline-correction", json=body)


@pytest.fixture
def drifting(running):
    """A patient whose baseline is 1.7 mm from where it was learned."""
    running.breaths = (Breath(drift=1.7),)
    running.frame()
    return running


@pytest.mark.parametrize(("action", "kind"), [("hold", HoldBeam), ("release", ReleaseBeam)])
def test_a_person_holds_and_releases_by_name(client, session_id, running, action, kind):
    assert act(client, session_id, action, operator="C. Nurse").status_code == 200
    assert running.commands == [kind(operator="C. Nurse")]
    row = audit_rows(client, f"session.{action}")[-1]
    assert (row["actor"], row["outcome"]) == ("C. Nurse", "done")


def test_a_hold_is_done_before_it_is_written_down_and_a_release_after(client, session_id, running):
    act(client, session_id, "hold")
    act(client, session_id, "release")
    assert [row["outcome"] for row in audit_rows(client, "session.hold")] == ["done"]
    assert [row["outcome"] for row in audit_rows(client, "session.release")] == ["requested", "done"]


def test_who_holds_is_reported_in_the_session(client, session_id, running):
    act(client, session_id, "hold", operator="C. Nurse")
    running.frame()
    gate = client.get(f"/api/v1/sessions/{session_id}").json()["gate"]
    assert gate["operator_hold"] == "C. Nurse"


def test_presence_reaches_the_engine_by_name_and_is_not_audited(client, session_id, running):
    before = len(audit_rows(client))
    for operator in ("A. Therapist", "B. Physicist"):
        answer = act(client, session_id, "presence", operator=operator)
        assert (answer.status_code, answer.content) == (204, b"")
    assert running.present == ["A. Therapist", "B. Physicist"]
    assert len(audit_rows(client)) == before


def test_presence_at_a_session_that_does_not_run_is_refused(client, session_id):
    assert act(client, session_id, "presence").status_code == 409


def test_a_correction_moves_the_window_and_the_audit_keeps_the_drift_and_both_windows(client, session_id, drifting):
    answer = correct(client, session_id)
    assert answer.status_code == 200, answer.text
    assert drifting.commands == [CorrectBaseline(operator="B. Physicist", by=1.5, may_exceed=True)]
    requested, done = audit_rows(client, ACTION)
    assert (requested["outcome"], done["outcome"], done["actor"]) == ("requested", "done", "B. Physicist")
    detail = done["detail"]
    assert {name: detail[name] for name in ("by", "unit", "drift_seen", "drift_known")} == {
        "by": 1.5,
        "unit": "mm",
        "drift_seen": 1.6,
        "drift_known": 1.7,
    }
    edges = [(window["lower"], window["upper"]) for (window,) in (detail["window_before"], detail["window_after"])]
    assert edges == [(-1.0, 3.0), (0.5, 4.5)]
    gate = client.get(f"/api/v1/sessions/{session_id}").json()["gate_window"]
    assert (gate["lower_mm"], gate["upper_mm"]) == (0.5, 4.5)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"by_mm": 5.1, "drift_mm": 5.2}, "by_mm"),
        ({"by_mm": -1.5}, "by_mm"),
        ({"by_mm": 2.7}, "by_mm"),
        ({"by_mm": 51.0}, "by_mm"),
        ({"by_mm": None}, "by_mm"),
        ({"drift_mm": None}, "drift_mm"),
        ({"by_l": 0.1}, "by_l"),
        ({"by_mm": None, "drift_mm": None, "by_l": 0.1, "drift_l": 0.1}, "by_l"),
        ({"operator": ""}, "operator"),
        ({"surprise": 1}, "surprise"),
    ],
    ids=str,
)
def test_a_correction_out_of_its_bound_is_refused_by_its_field_and_moves_nothing(
    client, session_id, drifting, changes, field
):
    answer = correct(client, session_id, **changes)
    assert (answer.status_code, answer.json()["field"]) == (422, field), answer.text
    assert drifting.commands == []
    assert audit_rows(client, ACTION)[-1]["outcome"] == "refused"


@pytest.mark.parametrize(
    ("breaths", "said"),
    [
        ((), "is not known now"),
        ((Breath(drift=None),), "is not known now"),
        ((Breath(signal=SignalChoice(signal="thorax"), drift=1.6),), "is not known now"),
        ((Breath(drift=2.7),), "the drift is 2.70 mm by now"),
        ((Breath(drift=-1.6),), "the drift is -1.60 mm by now"),
    ],
    ids=str,
)
def test_confirming_a_drift_that_is_over_is_refused(client, session_id, running, breaths, said):
    running.breaths = breaths
    running.frame()
    answer = correct(client, session_id)
    assert (answer.status_code, answer.json()["code"]) == (409, "command_refused")
    assert said in answer.json()["detail"]
    assert running.commands == []


def test_what_the_engine_finds_too_much_in_all_is_refused_by_the_field_it_came_in(client, session_id, drifting):
    drifting.refuse_with = InvalidValueError("by", 1.5, "a number from -9 to 1 mm, 4 mm of 5 already used")
    answer = correct(client, session_id)
    assert (answer.status_code, answer.json()["field"]) == (422, "by_mm")
    assert "4 mm of 5 already used" in answer.json()["bound"]
    assert [row["outcome"] for row in audit_rows(client, ACTION)] == ["requested", "refused"]


def test_a_window_on_the_volume_is_corrected_in_litres(client, session_id, running):
    volume = SignalChoice(signal="volume")
    running.window = AmplitudeWindow(choice=volume, lower=-0.1, upper=0.3, unit="l")
    running.breaths = (Breath(signal=volume, drift=0.12),)
    running.frame()
    assert correct(client, session_id).json()["field"] == "by_mm"
    litres = {"by_mm": None, "drift_mm": None, "by_l": 0.1, "drift_l": 0.1}
    assert correct(client, session_id, **litres | {"by_l": 0.51, "drift_l": 0.6}).json()["field"] == "by_l"
    assert correct(client, session_id, **litres).status_code == 200
    assert running.commands == [CorrectBaseline(operator="B. Physicist", by=0.1, may_exceed=True)]


def test_what_the_engine_refuses_of_a_correction_is_reported(client, session_id, drifting):
    drifting.refuse_with = REFUSED
    assert correct(client, session_id).status_code == 409
    assert audit_rows(client, ACTION)[-1]["outcome"] == "refused"


def test_a_session_that_does_not_run_is_not_corrected(client, session_id):
    assert correct(client, session_id).status_code == 409


def test_the_summary_and_the_transitions_count_from_the_capture(client, session_id, running):
    running.camera_ms = 20.0
    for _ in range(3):
        running.frame()
    moved = running.transition(running.gate)
    running.transitions.put_nowait(replace(moved, captured_ns=moved.asserted_ns - 27_000_000))
    url = f"/api/v1/sessions/{session_id}"
    eventually(lambda: len(client.get(f"{url}/transitions").json()["items"]) == 2)
    assert [one["latency_ms"] for one in client.get(f"{url}/transitions").json()["items"]] == [None, 27.0]
    act(client, session_id, "stop")
    latency = client.get(url).json()["summary"]["latency"]
    assert latency == {"p50_ms": 25.001, "p99_ms": 25.002, "max_ms": 25.002}
    rows = client.get(f"{url}/samples").text.splitlines()
    assert rows[1].endswith(",1005000000,980000000,")


def test_the_phase_of_the_gated_signal_is_kept_with_every_sample(client, session_id, running):
    running.breaths = (Breath(phase_percent=37.5, phase_confidence=0.9, note=""),)
    running.frame()
    running.frame(whole_mm=None)
    act(client, session_id, "stop")
    rows = client.get(f"/api/v1/sessions/{session_id}/samples").text.splitlines()
    assert [row.split(",")[13] for row in rows] == ["phase_percent", "37.5", ""]
