"""The trace of a session that is over: ranges that keep every extreme, stretches of beam and holds, and one moment."""

import numpy as np
import pytest

from engine.core.gate_state import GateState, HoldReason
from tests.support.service.api_calls import act
from tests.support.service.fake_engine import FRAME_NS
from tests.support.waiting import eventually

FRAME_S = FRAME_NS / 1e9
SPIKE = 137
LOST = range(200, 240)
ON = range(300, 330)
HELD = range(400, 410)
FRAMES = 600


@pytest.fixture
def over(client, session_id, running):
    """A session of 600 frames with a spike, a loss, one stretch of beam and a hold by a person."""
    for i in range(FRAMES):
        running.gate = GateState.BEAM_ON if i in ON else GateState.HOLD
        running.reason = HoldReason.OPERATOR_HOLD if i in HELD else HoldReason.OUTSIDE_WINDOW
        running.frame(whole_mm=None if i in LOST else 50.0 if i == SPIKE else 2.0 * np.sin(i / 20))
    running.gate = GateState.HOLD
    eventually(running.samples.empty)
    act(client, session_id, "stop")
    return session_id


def trace(client, session_id, **asked):
    answer = client.get(f"/api/v1/sessions/{session_id}/trace", params=asked)
    assert answer.status_code == 200, answer.text
    return answer.json()


def whole(found):
    (signal,) = (one for one in found["signals"] if one["signal"] == "whole")
    return signal


@pytest.mark.parametrize("points", [10, 60, 599])
def test_ranges_keep_each_extreme_and_what_was_not_measured_stays_unknown(client, over, points):
    found = trace(client, over, points=points, to_s=FRAMES * FRAME_S)
    low, high = whole(found)["low_mm"], whole(found)["high_mm"]
    assert len(found["times_s"]) == len(low) == len(high) <= points
    assert max(one for one in high if one is not None) == 50.0
    assert min(one for one in low if one is not None) == pytest.approx(-2.0, abs=0.01)
    assert found["step_s"] == pytest.approx((FRAMES - 1) * FRAME_S / points, rel=0.01)
    unknown = [t for t, one in zip(found["times_s"], high, strict=True) if one is None]
    assert all(200 * FRAME_S - 0.001 <= t < 240 * FRAME_S for t in unknown)
    assert bool(unknown) is (points > 20)


def test_few_samples_are_returned_as_they_are(client, over):
    found = trace(client, over, from_s=100 * FRAME_S - 0.001, to_s=150 * FRAME_S - 0.001, points=60)
    assert found["step_s"] == 0.0
    assert found["times_s"] == pytest.approx([i * FRAME_S for i in range(100, 150)], abs=1e-3)
    assert whole(found)["low_mm"] == whole(found)["high_mm"]
    assert whole(found)["low_mm"][SPIKE - 100] == 50.0


def test_beam_and_holds_are_stretches_and_the_windows_own_holds_are_none(client, over):
    found = trace(client, over)
    assert found["beams_s"] == [pytest.approx([300 * FRAME_S, 330 * FRAME_S], abs=1e-3)]
    (hold,) = found["holds"]
    assert (hold["gate"], hold["reason"]) == ("hold", "operator_hold")
    assert [hold["from_s"], hold["to_s"]] == pytest.approx([400 * FRAME_S, 410 * FRAME_S], abs=1e-3)
    assert trace(client, over, from_s=12.0, to_s=12.5)["beams_s"] == []


def test_a_moment_is_the_nearest_sample_with_its_cells(client, over):
    found = client.get(f"/api/v1/sessions/{over}/moment", params={"at_s": (SPIKE + 0.4) * FRAME_S}).json()
    assert (found["frame_index"], found["whole_mm"], found["gate"]) == (SPIKE, 50.0, "hold")
    lost = client.get(f"/api/v1/sessions/{over}/moment", params={"at_s": 210 * FRAME_S}).json()
    assert (lost["whole_mm"], lost["cells_mm"], lost["surface_mm"]) == (None, [], [])
    last = client.get(f"/api/v1/sessions/{over}/moment", params={"at_s": 100_000}).json()
    assert last["frame_index"] == FRAMES - 1


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"from_s": 5, "to_s": 5}, "to_s"),
        ({"from_s": -1}, "from_s"),
        ({"to_s": "nan"}, "to_s"),
        ({"points": 9}, "points"),
        ({"points": 5001}, "points"),
    ],
)
def test_a_part_out_of_bounds_is_refused_with_its_field(client, over, asked, field):
    answer = client.get(f"/api/v1/sessions/{over}/trace", params=asked)
    assert answer.status_code == 422
    assert field in str(answer.json())


def test_a_running_session_has_no_review(client, session_id, running):
    running.frame()
    for part in ("trace", "moment"):
        answer = client.get(f"/api/v1/sessions/{session_id}/{part}")
        assert (answer.status_code, answer.json()["code"]) == (409, "session_state")


def test_a_session_without_samples_has_an_empty_trace_and_no_moment(client, session_id, running):
    act(client, session_id, "stop")
    found = trace(client, session_id)
    assert (found["times_s"], found["end_s"], found["beams_s"], found["holds"]) == ([], 0.0, [], [])
    assert client.get(f"/api/v1/sessions/{session_id}/moment").status_code == 409
