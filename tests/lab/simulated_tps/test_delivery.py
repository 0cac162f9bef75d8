"""How a planning system counts beam-on time: frame by frame, and never too little of what it did not see."""

import pytest

from lab.simulated_tps.delivery import Beam, BeamClock, DeliveredBeams, Seen, recorded

FRAME_US = 33_333


def seen(frame, *, is_on):
    return Seen(frame_index=frame, timestamp_us=frame * FRAME_US, is_on=is_on)


def counted(*frames):
    clock = BeamClock()
    for frame, is_on in frames:
        clock.note(seen(frame, is_on=is_on))
    return clock


def test_beam_on_time_runs_from_a_frame_with_the_beam_on_to_the_next_frame():
    clock = counted((0, False), (1, True), (2, True), (3, False), (4, False))
    assert clock.on_s == pytest.approx(2 * FRAME_US / 1e6)
    assert clock.unseen_s == 0.0


@pytest.mark.parametrize(("before", "behind"), [(True, True), (True, False), (False, True)])
def test_an_unseen_interval_counts_as_on_if_either_end_was_on(before, behind):
    clock = counted((0, before), (10, behind))
    assert clock.on_s == pytest.approx(10 * FRAME_US / 1e6)
    assert clock.unseen_s == clock.on_s


def test_frames_that_were_missed_between_two_without_beam_may_have_had_it():
    clock = BeamClock()
    clock.note(Seen(frame_index=0, timestamp_us=0, is_on=False))
    clock.note(Seen(frame_index=30, timestamp_us=1_000_000, is_on=False))
    assert (clock.on_s, clock.unseen_s) == (0.0, 1.0)


def test_a_gap_between_two_frames_with_the_beam_off_counts_nothing():
    assert counted((0, False), (10, False)).on_s == 0.0


def test_frames_that_come_again_after_a_break_change_nothing():
    clock = counted((0, True), (1, True), (2, True), (1, True), (2, True), (3, False))
    assert clock.on_s == pytest.approx(3 * FRAME_US / 1e6)
    assert sorted(clock.frames) == [0, 1, 2, 3]


def test_the_recorder_s_rows_are_counted_the_same_way():
    gates = ["disarmed", "hold", "beam_on", "beam_on", "hold", "beam_on", "fault"]
    rows = [
        {"frame_index": str(index), "timestamp_us": str(index * FRAME_US), "gate": gate}
        for index, gate in enumerate(gates)
    ]
    found = recorded(rows)
    assert (len(found.frames), found.rises) == (7, 2)
    assert found.on_s == pytest.approx(3 * FRAME_US / 1e6)


def test_a_ledger_goes_from_beam_to_beam_and_keeps_what_each_was_given():
    ledger = DeliveredBeams([Beam(number=1, name="AP", seconds=2.0), Beam(number=3, name="PA", seconds=1.0)])
    ledger.add(2.1)
    assert (ledger.is_beam_done, ledger.is_last, ledger.is_done) == (True, False, False)
    ledger.next_beam()
    assert (ledger.current.number, ledger.is_beam_done) == (3, False)
    ledger.add(1.0)
    assert ledger.is_done
    assert [(one.number, one.planned_s, one.delivered_s) for one in ledger.reports()] == [(1, 2.0, 2.1), (3, 1.0, 1.0)]
