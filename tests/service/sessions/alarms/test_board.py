"""The board of alarms: when one begins, who acknowledges it, and when it ends."""

import pytest
from hypothesis import given, strategies as st

from engine.core.clock import NS_PER_S
from service.core.alarm_table import ALARMS
from service.sessions.alarms.board import CLEAR_NS, AlarmBoard, AlarmEventKind
from tests.support.stream.fake_runner import utc_of

A, B = "a" * 32, "b" * 32
LOST, SHIFTED, MARKER = "source_lost", "patient_shifted", "marker_lost"
BEAM = "beam_without_permit"
START_NS = 1_000 * NS_PER_S
STEP_NS = NS_PER_S // 20


class Room:
    """A board whose time a test moves."""

    def __init__(self) -> None:
        self.board = AlarmBoard(utc_of)
        self.now_ns = START_NS

    def look(self, *codes: str, session_id: str = A, seconds: float = 0.0) -> None:
        """Look once, or every 50 ms for some seconds, at the same conditions."""
        for _ in range(round(seconds * NS_PER_S / STEP_NS) or 1):
            self.board.update(session_id, dict.fromkeys(codes, "why"), self.now_ns)
            self.now_ns += STEP_NS

    def acknowledge(self, *numbers: int, operator: str = "A. Therapist", session_id: str = A) -> None:
        self.board.acknowledge(session_id, numbers, operator, self.now_ns)

    @property
    def codes(self) -> list[str]:
        return [alarm.rule.code for alarm in self.board.active]

    @property
    def events(self) -> list[tuple[str, str]]:
        return [(event.kind.value, event.alarm.rule.code) for event in self.board.events_after(0)]


@pytest.fixture
def room() -> Room:
    return Room()


def test_a_fault_is_an_alarm_at_once_with_its_time_and_detail(room: Room):
    room.look(LOST)
    (alarm,) = room.board.active
    assert (alarm.session_id, alarm.rule.code, alarm.detail) == (A, LOST, "why")
    assert alarm.since == utc_of(START_NS)
    assert alarm.acknowledged_by is None
    assert room.events == [("begin", LOST)]


def test_an_alarm_begins_once_however_often_it_is_seen(room: Room):
    room.look(LOST, seconds=10.0)
    assert room.events == [("begin", LOST)]


def test_a_fault_lasts_until_a_person_acknowledges_it_though_its_cause_is_gone(room: Room):
    room.look(LOST)
    room.look(seconds=60.0)
    assert room.codes == [LOST]
    room.acknowledge(room.board.active[0].number)
    assert room.codes == []
    assert room.events == [("begin", LOST), ("acknowledged", LOST), ("end", LOST)]
    ended = room.board.events_after(2)[0]
    assert (ended.alarm.acknowledged_by, ended.active) == ("A. Therapist", ())


def test_a_fault_that_persists_is_a_new_alarm_that_no_one_has_acknowledged(room: Room):
    room.look(LOST)
    first = room.board.active[0].number
    room.acknowledge(first)
    room.look(LOST)
    (again,) = room.board.active
    assert again.number == first + 1
    assert again.acknowledged_by is None


def test_a_hold_is_an_alarm_only_after_its_delay_and_counts_from_its_beginning(room: Room):
    delay_s = ALARMS[SHIFTED].delay_s
    room.look(SHIFTED, seconds=delay_s)
    assert room.codes == []
    room.look(SHIFTED)
    assert room.codes == [SHIFTED]
    assert room.board.active[0].since == utc_of(START_NS)


def test_a_hold_that_clears_before_its_delay_is_none(room: Room):
    room.look(MARKER, seconds=ALARMS[MARKER].delay_s - 0.5)
    room.look(seconds=2.0)
    room.look(MARKER, seconds=ALARMS[MARKER].delay_s - 0.5)
    assert room.events == []


def test_a_hold_that_flickers_is_one_alarm(room: Room):
    for _ in range(40):
        room.look(MARKER, seconds=0.3)
        room.look(seconds=0.5)
    assert room.events == [("begin", MARKER)]
    room.look(seconds=CLEAR_NS / NS_PER_S + 0.1)
    assert room.events == [("begin", MARKER), ("end", MARKER)]


def test_an_acknowledged_hold_stays_until_it_clears_and_names_who_acknowledged_first(room: Room):
    room.look(SHIFTED, seconds=3.0)
    number = room.board.active[0].number
    room.acknowledge(number)
    room.acknowledge(number, operator="B. Physicist")
    room.look(SHIFTED, seconds=3.0)
    assert room.board.active[0].acknowledged_by == "A. Therapist"
    room.look(seconds=2.0)
    assert room.events == [("begin", SHIFTED), ("acknowledged", SHIFTED), ("end", SHIFTED)]


def test_an_alarm_that_begins_later_is_not_acknowledged_with_those_that_were_seen(room: Room):
    room.look(LOST)
    seen = [alarm.number for alarm in room.board.active]
    room.look(LOST, BEAM)
    room.acknowledge(*seen)
    assert room.codes == [BEAM]
    assert room.board.active[0].acknowledged_by is None


def test_the_most_urgent_stands_first_and_those_not_acknowledged_before_the_others(room: Room):
    room.look(MARKER, SHIFTED, LOST, seconds=6.0)
    room.look(MARKER, SHIFTED, LOST, BEAM)
    assert room.codes == [BEAM, LOST, SHIFTED, MARKER]
    room.acknowledge(next(alarm.number for alarm in room.board.active if alarm.rule.code == SHIFTED))
    assert room.codes == [BEAM, LOST, SHIFTED, MARKER]
    room.look(MARKER, SHIFTED, LOST, BEAM, "camera_moved", seconds=3.0)
    assert room.codes == [BEAM, LOST, "camera_moved", SHIFTED, MARKER]


def test_the_end_of_a_session_ends_what_does_not_latch(room: Room):
    room.look(SHIFTED, LOST, seconds=3.0)
    room.board.end_session(A, room.now_ns)
    assert room.codes == [LOST]
    room.look(SHIFTED, BEAM, seconds=5.0)
    assert room.codes == [LOST], "a look that comes late begins nothing"
    room.acknowledge(room.board.active[0].number)
    assert room.codes == []


def test_a_latched_alarm_of_an_earlier_session_ends_when_the_next_one_begins(room: Room):
    room.look(LOST)
    room.board.end_session(A, room.now_ns)
    room.look(session_id=B)
    assert room.codes == []
    assert room.events == [("begin", LOST), ("end", LOST)]
    room.look(BEAM, session_id=B)
    assert [alarm.session_id for alarm in room.board.active] == [B]


def test_an_acknowledgement_for_another_session_does_nothing(room: Room):
    room.look(LOST)
    room.acknowledge(room.board.active[0].number, session_id=B)
    assert room.board.active[0].acknowledged_by is None
    assert room.board.active_of(B) == ()


def test_each_event_carries_the_alarms_after_it_and_a_number_without_a_gap(room: Room):
    room.look(LOST)
    room.look(LOST, BEAM)
    room.acknowledge(1)
    events = room.board.events_after(0)
    assert [event.number for event in events] == list(range(1, len(events) + 1))
    assert [[alarm.rule.code for alarm in event.active] for event in events] == [
        [LOST],
        [BEAM, LOST],
        [BEAM, LOST],
        [BEAM],
    ]
    assert room.board.events_after(events[-1].number) == []
    assert room.board.newest_event == events[-1].number


@given(
    st.lists(st.tuples(st.sets(st.sampled_from(sorted(ALARMS))), st.booleans(), st.sampled_from([A, B])), max_size=60)
)
def test_the_events_alone_tell_which_alarms_are_active(steps):
    room = Room()
    told: dict[int, str] = {}
    for codes, acknowledges, session_id in steps:
        room.look(*codes, session_id=session_id, seconds=1.5)
        if acknowledges:
            room.acknowledge(*(alarm.number for alarm in room.board.active), session_id=session_id)
    for event in room.board.events_after(0):
        if event.kind is AlarmEventKind.BEGIN:
            assert event.alarm.rule.code not in told.values(), "one alarm of a kind at a time"
            told[event.alarm.number] = event.alarm.rule.code
        elif event.kind is AlarmEventKind.END:
            del told[event.alarm.number]
        assert {alarm.number for alarm in event.active} == told.keys()
    assert {alarm.number for alarm in room.board.active} == told.keys()
