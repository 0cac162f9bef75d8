"""A client that comes back gets what it missed from the record, then the live stream: no frame twice, none missing."""

import json
from dataclasses import replace

import pytest

from engine.core.gate_state import GateState
from tests.support.stream.stream_server import Served, messages, next_of
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


def told(connection, *, until: int) -> list[dict]:
    """Read up to the sample of a frame."""
    found = []
    for message in messages(connection):
        found.append(message)
        if message["type"] == "sample" and message["frame_index"] >= until:
            break
    return found


def frames_of(found: list[dict]) -> list[int]:
    return [one["frame_index"] for one in found if one["type"] == "sample"]


def kinds_of(found: list[dict]) -> list[str]:
    return [one["type"] if one["type"] != "sample" else one["form"] for one in found]


@pytest.fixture(autouse=True)
def patient():
    """Time limits that a slow machine does not reach; a test about one of them sets its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.web.stream.resume.RECORDER_WAIT_S", PATIENCE_S)
        patch.setattr("service.web.stream.resume.BUSY_S", PATIENCE_S)
        yield


class SlowRecorder:
    """Seems to be no further than a frame; `page` is the record as it is."""

    def __init__(self, service: Served, monkeypatch, frame: int) -> None:
        self.frame = frame
        tails = service.app.state.resumption._tails
        self.page = tails.page
        monkeypatch.setattr(tails, "page", self._page)

    def _page(self, session_id, after, *, oldest_ns, most):
        found = self.page(session_id, after, oldest_ns=oldest_ns, most=most)
        return replace(found, rows=[row for row in found.rows if row["frame_index"] <= self.frame])


def test_what_was_missed_comes_from_the_record_and_the_seam_has_no_frame_twice_and_none_missing(
    service: Served, session_id: str, monkeypatch
):
    with service.watch():
        service.frames(30)
        service.recorded(session_id, 29)
        recorder = SlowRecorder(service, monkeypatch, 20)  # far behind at first
        with service.watch(f"?session_id={session_id}&after_frame=9") as again:
            hello = next_of(again, "hello")
            service.frames(3)
            eventually(lambda: recorder.page(session_id, 31, oldest_ns=0, most=1).rows)
            recorder.frame = 30  # it got past the first frame that is kept, not to the newest
            found = told(again, until=32)
    assert (hello["session_id"], hello["resumes_after"]) == (session_id, 9)
    assert frames_of(found) == list(range(10, 33))
    kinds = kinds_of(found)
    assert kinds == ["recorded"] * 21 + ["resumed"] + ["full"] * 2
    assert (found[21]["frames"], found[21]["last_frame"]) == (21, 30)


def test_a_client_that_saw_nothing_gets_all_that_was_recorded(service: Served, session_id: str):
    with service.watch():
        service.frames(12)
        with service.watch(f"?session_id={session_id}&after_frame=-1&form=thin") as again:
            assert frames_of(told(again, until=11)) == list(range(12))


def test_a_recorded_sample_states_what_the_live_one_stated(service: Served, session_id: str):
    with service.watch() as first:
        next_of(first, "hello")
        live = {}
        for _ in range(3):
            service.frames(1)
            sample = next_of(first, "sample")
            live[sample["frame_index"]] = sample
        service.recorded(session_id, 2)
        with service.watch(f"?session_id={session_id}&after_frame=0") as again:
            recorded = next(one for one in messages(again) if one["type"] == "sample")
    assert recorded["form"] == "recorded"
    same = set(recorded) - {"form", "type", "sent_at", "received_at", "captured_at", "latency_ms"}
    assert {name: recorded[name] for name in same} == {name: live[1][name] for name in same}
    assert recorded["received_at"] is not None


def test_what_is_further_back_than_the_site_sends_again_is_stated_to_be_missing(
    service: Served, session_id: str, monkeypatch
):
    monkeypatch.setattr(service.app.state.resumption, "_longest_s", 0.5)  # fifteen frames of the fake engine
    with service.watch():
        service.frames(40)
        service.recorded(session_id, 39)
        with service.watch(f"?session_id={session_id}&after_frame=3") as again:
            found = told(again, until=39)
    gap = found[1]
    first = frames_of(found)[0]
    assert (gap["type"], gap["from_frame"], gap["to_frame"], gap["reason"]) == ("gap", 4, first - 1, "too_long_ago")
    assert 20 < first <= 25
    assert frames_of(found) == list(range(first, 40))


def test_a_session_that_is_over_is_reported_to_its_end_from_its_closed_file(service: Served):
    session_id = service.begin_session()
    with service.watch():
        service.frames(20)
    service.end_session(session_id)
    with service.watch(f"?session_id={session_id}&after_frame=4") as again:
        found = told(again, until=19)
        resumed = next_of(again, "resumed")
        assert next_of(again, "idle")
    assert frames_of(found) == list(range(5, 20))
    assert (resumed["frames"], resumed["last_frame"]) == (15, 19)


def test_a_session_that_no_one_recorded_is_one_gap(service: Served):
    with service.watch(f"?session_id={'e' * 32}&after_frame=7") as again:
        gap = next_of(again, "gap")
        assert (gap["from_frame"], gap["to_frame"], gap["reason"]) == (8, None, "not_recorded")
        assert next_of(again, "resumed")["frames"] == 0
        assert next_of(again, "idle")


def test_a_recorder_that_does_not_get_there_is_waited_for_and_not_for_ever(
    service: Served, session_id: str, monkeypatch
):
    monkeypatch.setattr("service.web.stream.resume.RECORDER_WAIT_S", 0.2)
    with service.watch():
        service.frames(10)
        service.recorded(session_id, 9)
        SlowRecorder(service, monkeypatch, 5)
        with service.watch(f"?session_id={session_id}&after_frame=1") as again:
            found = told(again, until=9)
    assert kinds_of(found) == ["hello", *["recorded"] * 4, "gap", "resumed", "full"]
    assert frames_of(found) == [2, 3, 4, 5, 9]
    gap = next(one for one in found if one["type"] == "gap")
    assert (gap["from_frame"], gap["to_frame"], gap["reason"]) == (6, 8, "recorder_behind")


def test_a_change_between_two_frames_is_reported_though_its_frame_was_in_the_record(service: Served, session_id: str):
    with service.watch():
        service.frames(5)
        service.recorded(session_id, 4)
        with service.watch(f"?session_id={session_id}&after_frame=4") as again:
            assert next_of(again, "resumed")["last_frame"] == 4
            service.change(GateState.HOLD)
            change = next_of(again, "sample")
    assert (change["frame_index"], change["gate"]) == (4, "hold")


def test_an_asked_rate_holds_for_the_record_too_and_no_change_is_left_out(service: Served, session_id: str):
    with service.watch():
        service.frames(20)
        service.running.gate = GateState.HOLD
        service.frames(1)
        service.running.gate = GateState.DISARMED
        service.frames(20)
        service.recorded(session_id, 40)
        with service.watch(f"?session_id={session_id}&after_frame=-1&rate_hz=3") as again:
            found = []
            for one in messages(again):
                found.append(one)
                if one["type"] == "resumed":
                    break
    frames = frames_of(found)
    assert {20, 21} <= set(frames)
    assert 5 <= len(frames) <= 8


def test_too_many_that_come_back_at_once_are_reported_so_and_go_on_live(service: Served, session_id: str, monkeypatch):
    monkeypatch.setattr("service.web.stream.resume.BUSY_S", 0.05)
    with service.watch():
        service.frames(6)
        limiter = service.app.state.resumption._limiter
        tokens, limiter.total_tokens = limiter.total_tokens, 0
        try:
            with service.watch(f"?session_id={session_id}&after_frame=1") as again:
                found = told(again, until=5)
        finally:
            limiter.total_tokens = tokens
    assert kinds_of(found) == ["hello", "gap", "resumed", "full"]
    assert (found[1]["from_frame"], found[1]["to_frame"], found[1]["reason"]) == (2, 4, "busy")


@pytest.mark.parametrize("query", ["?after_frame=3", f"?session_id={'0' * 32}"])
def test_to_resume_takes_both_the_session_and_the_frame(service: Served, query: str):
    with service.http() as client:
        answer = client.get(f"/api/v1/live/events{query}")
    assert answer.status_code == 422
    assert "given together with" in json.loads(answer.content)["bound"]
