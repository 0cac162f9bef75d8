"""What was delivered so far, from the service: the same in every answer, while the session runs and after it."""

from datetime import datetime, timedelta

import pytest

from engine.core.gate_state import GateState, HoldReason
from tests.support.service.api_calls import act
from tests.support.service.fake_engine import FRAME_NS
from tests.support.waiting import eventually


def detail(client, session_id):
    return client.get(f"/api/v1/sessions/{session_id}").json()


def deliver(running, frames: int) -> None:
    """Switch on, and take so many frames with the beam on, and one without."""
    running.transition(GateState.BEAM_ON)
    for _ in range(frames):
        running.frame(line_on=True)
    running.transition(GateState.HOLD, HoldReason.OUTSIDE_WINDOW)
    running.frame()


def test_beam_on_time_duty_cycle_and_holds_are_counted_and_stay_after_the_end(client, session_id, running):
    running.transition(GateState.HOLD, HoldReason.MARKER_LOST)
    running.frame()
    deliver(running, 30)
    deliver(running, 15)
    eventually(lambda: detail(client, session_id)["summary"]["frames"] == 48)
    summary = detail(client, session_id)["summary"]
    assert summary["beam_on_s"] == pytest.approx(45 * FRAME_NS / 1e9, abs=0.001)
    assert summary["duty_cycle"] == pytest.approx(45 / 48)
    found = [(one["reason"], one["text"], one["count"]) for one in summary["holds"]]
    assert found == [("outside_window", "Outside the window", 2), ("marker_lost", "A marker is not visible", 1)]
    act(client, session_id, "stop")
    ended = detail(client, session_id)
    assert ended["summary"]["beam_on_s"] == summary["beam_on_s"]
    kept = {one["reason"]: one["count"] for one in ended["summary"]["holds"]}
    assert kept == {"outside_window": 2, "marker_lost": 1, "engine_stopped": 1}
    began, over = (datetime.fromisoformat(ended[name]) for name in ("started_at", "ended_at"))
    assert ended["summary"]["elapsed_s"] == pytest.approx((over - began) / timedelta(seconds=1), abs=0.001)


def test_the_time_runs_from_the_start_and_not_before(client, session_id):
    assert detail(client, session_id)["summary"]["elapsed_s"] is None
    act(client, session_id, "start")
    first = detail(client, session_id)["summary"]["elapsed_s"]
    assert first >= 0.0
    eventually(lambda: detail(client, session_id)["summary"]["elapsed_s"] > first)


def test_the_time_of_the_gate_s_state_is_that_of_its_change_in_the_audit(client, session_id, running):
    running.frame()
    assert detail(client, session_id)["gate"]["state_since"] is None
    running.transition(GateState.HOLD, HoldReason.MARKER_LOST)
    running.reason = HoldReason.MARKER_LOST
    running.frame()
    eventually(lambda: detail(client, session_id)["gate"]["state_since"] is not None)
    (change,) = client.get(f"/api/v1/sessions/{session_id}/transitions").json()["items"]
    assert detail(client, session_id)["gate"]["state_since"] == change["at"]
    running.reason = HoldReason.JUMP
    running.frame()
    assert detail(client, session_id)["gate"]["state_since"] is None, "the audit does not have this reason yet"
