"""No transition is lost to a kill: what the journal's file holds at every instant, read as the next start would."""

import contextlib
import random
import threading
from dataclasses import replace

import pytest

from engine.control.journal.format import (
    HEADER_BYTES,
    SLOT_BYTES,
    JournalFormatError,
    RecoveredJournal,
    read_journal,
    slot_offset,
)
from engine.control.journal.journal import RESERVED_SLOTS, JournalError, TransitionJournal, boot_id
from engine.control.output_queues import OutputQueues
from engine.core.clock import ManualClock, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import ON_AT, armed_bench
from tests.support.control.loop_bench import WatchedBeamLine, drained, good
from tests.support.gating.streams import LIMITS, MS, unmeasured

from engine.core.frames import MeasurementState  # isort: skip
from tests.support.control.transitions import transition

SMALL = RESERVED_SLOTS + 16


@pytest.fixture
def journal(tmp_path):
    made = TransitionJournal(tmp_path / "ring", session_id="s1", clock=ManualClock(11), slots=SMALL)
    yield made
    made.close()


def kept(journal: TransitionJournal) -> RecoveredJournal:
    """What a start after a kill at this instant would read: the file through the page cache, not our mapping."""
    return read_journal(journal.path.read_bytes())


def path(journal: TransitionJournal) -> list[str]:
    return [f"{entry.transition.to_state}{'' if entry.is_committed else '?'}" for entry in kept(journal).entries]


def test_a_permit_is_in_the_file_before_the_command_to_the_line(journal):
    seen: list[list[str]] = []

    class Looking(WatchedBeamLine):
        def permit(self, lease):
            seen.append(path(journal))
            super().permit(lease)

    armed_bench([good] * 6, beam=Looking, journal=journal).run()
    assert seen[0] == ["hold", "dwell", "beam_on?"]
    assert seen[1] == ["hold", "dwell", "beam_on"]


def test_a_hold_waits_for_nothing_and_is_in_the_file_when_the_line_was_commanded(journal):
    seen: list[str] = []

    class Looking(WatchedBeamLine):
        def hold(self, reason):
            seen.append(path(journal)[-1] if kept(journal).entries else "")
            super().hold(reason)

    bench = armed_bench([good] * 8, beam=Looking, journal=journal)
    bench.pipeline.spoil[ON_AT + 1] = lambda frame: unmeasured(frame, MeasurementState.TRAINING)
    bench.run()
    first_hold = seen.index("beam_on")
    assert seen[first_hold : first_hold + 2] == ["beam_on", "hold"]  # commanded first, recorded before the next frame


def test_the_file_reports_the_same_transitions_as_the_queue_under_the_same_numbers(journal):
    bench = armed_bench([good] * 8, journal=journal).run()
    queued = bench.transitions()
    assert [entry.transition for entry in kept(journal).entries] == queued
    assert [change.number for change in queued] == [1, 2, 4, 5]  # 3 is the prepared permit


def test_a_permit_that_the_line_refused_is_kept_as_what_became_of_it(journal):
    class Refusing(WatchedBeamLine):
        def permit(self, _lease):
            raise BeamLineError("no")

    armed_bench([good] * 6, beam=Refusing, journal=journal).run()
    assert path(journal)[:3] == ["hold", "dwell", "fault"]


def test_what_was_prepared_and_aborted_is_no_transition(journal):
    number = journal.prepare(transition())
    assert path(journal) == ["beam_on?"]
    journal.abort(transition(), number)
    assert path(journal) == []


def test_a_permit_that_cannot_be_kept_is_never_sent(journal):
    def broken(_transition):
        raise RuntimeError("no journal")

    journal.prepare = broken
    bench = armed_bench([good] * 6, journal=journal).run()
    assert bench.beam.permits == []
    assert path(journal)[-1] == "fault"


def test_a_watchdog_s_fault_is_kept_from_its_own_thread_in_the_queue_s_order(journal):
    outbox = OutputQueues(sample_capacity=1, transition_capacity=60, journal=journal)
    fault = transition(to_state=GateState.FAULT, reason=HoldReason.WATCHDOG)
    threads = [threading.Thread(target=outbox.put_transition, args=(fault,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [entry.transition for entry in kept(journal).entries] == drained(outbox.transitions)


def test_a_ring_that_would_overwrite_what_the_audit_has_not_is_trouble_until_it_is_acknowledged(journal):
    outbox = OutputQueues(sample_capacity=1, transition_capacity=1000, journal=journal)
    while outbox.trouble() is None:
        outbox.put_transition(transition())
    queued = drained(outbox.transitions)
    assert outbox.trouble() is HoldReason.AUDIT_BEHIND
    assert len(queued) <= SMALL
    assert [entry.transition for entry in kept(journal).entries] == queued  # nothing was overwritten
    journal.acknowledge(queued[-1].number)
    assert outbox.trouble() is None


def test_a_ring_that_went_round_keeps_the_newest_and_names_no_number_missing(journal):
    for number in range(1, 3 * SMALL + 5):
        journal.commit(transition(number))
    found = kept(journal)
    assert [entry.transition.at_ns for entry in found.entries] == list(range(2 * SMALL + 5, 3 * SMALL + 5))
    assert found.damaged_slots == found.missing_numbers == ()


@pytest.mark.parametrize("seed", range(60))
def test_a_slot_damaged_anywhere_is_stated_and_never_believed(journal, seed):
    chance = random.Random(seed)
    for number in range(1, 9):
        journal.commit(transition(number, detail="x" * chance.randrange(900)))
    content = bytearray(journal.path.read_bytes())
    victim = chance.randrange(8)
    at = HEADER_BYTES + victim * SLOT_BYTES + chance.randrange(SLOT_BYTES)
    content[at] ^= 1 << chance.randrange(8)
    found = read_journal(bytes(content))
    assert found.damaged_slots == (victim,)
    assert [entry.transition.at_ns for entry in found.entries] == [at for at in range(1, 9) if at != victim + 1]
    assert found.missing_numbers == (() if victim == 7 else (victim + 1,))


def test_a_write_torn_by_a_kill_leaves_the_ones_before_it(journal):
    journal.commit(transition(1))
    before = journal.path.read_bytes()
    journal.commit(transition(2))
    after = journal.path.read_bytes()
    at = slot_offset(2, SMALL)
    for torn in range(1, SLOT_BYTES):
        found = read_journal(after[: at + torn] + before[at + torn :])
        believed = [entry.transition.at_ns for entry in found.entries]
        assert (believed == [1] and found.damaged_slots == (1,)) or believed == [1, 2]


def test_a_slot_in_another_s_place_is_not_believed(journal):
    journal.commit(transition(1))
    content = bytearray(journal.path.read_bytes())
    slot = content[slot_offset(1, SMALL) : slot_offset(1, SMALL) + SLOT_BYTES]
    content[slot_offset(5, SMALL) : slot_offset(5, SMALL) + SLOT_BYTES] = slot
    found = read_journal(bytes(content))
    assert len(found.entries) == 1
    assert found.damaged_slots == (4,)


@pytest.mark.parametrize("length", [0, 10, HEADER_BYTES - 1, HEADER_BYTES + SLOT_BYTES])
def test_a_file_of_another_length_is_no_journal(journal, length):
    with pytest.raises(JournalFormatError):
        read_journal(journal.path.read_bytes()[:length])


def test_a_header_with_one_bit_changed_is_no_journal(journal):
    content = bytearray(journal.path.read_bytes())
    content[20] ^= 1
    with pytest.raises(JournalFormatError, match="header"):
        read_journal(bytes(content))


def test_the_header_states_whose_it_is_and_ties_both_clocks(tmp_path):
    clock = MonotonicClock()
    before_ns = clock.now_ns()
    journal = TransitionJournal(tmp_path / "ring", session_id="abc", clock=clock)
    header = kept(journal).header
    journal.close()
    assert (header.session_id, header.boot_id) == ("abc", boot_id())
    assert before_ns <= header.anchor_ns <= clock.now_ns()


def test_text_without_end_is_cut_and_states_it_and_odd_text_comes_back(journal):
    journal.commit(transition(1, detail="ü" * 5000, operator="Ø" * 300))
    journal.commit(transition(2, detail="ü🫁 \n", operator="Dr. Ø", reason=HoldReason.DWELL, armed_by="Schw. Æ"))
    journal.commit(transition(3, detail="ü" * 5000, operator="Ø" * 300, armed_by="Ø" * 80))
    first, second, third = (entry.transition for entry in kept(journal).entries)
    assert first.detail.endswith("... (cut)")
    assert first.operator.endswith("... (cut)")
    assert (second.detail, second.operator, second.reason) == ("ü🫁 \n", "Dr. Ø", HoldReason.DWELL)
    assert (first.armed_by, second.armed_by, third.armed_by) == (None, "Schw. Æ", "Ø" * 80)
    assert third.detail.endswith("... (cut)")


def test_the_file_goes_when_the_audit_has_everything_and_stays_when_it_lacks_one(tmp_path):
    for confirmed, remains in ((2, False), (1, True)):
        journal = TransitionJournal(tmp_path / f"ring{confirmed}", session_id="s", clock=ManualClock())
        journal.commit(transition(1))
        journal.commit(transition(2))
        journal.acknowledge(confirmed)
        journal.close()
        assert journal.path.exists() is remains


def test_a_closed_journal_is_not_written_to(journal):
    journal.close()
    assert journal.commit(transition()) == 1
    assert not journal.path.exists()


def test_only_its_owner_can_read_it_and_no_link_is_followed(tmp_path, journal):
    assert journal.path.stat().st_mode & 0o777 == 0o600
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(JournalError):
        TransitionJournal(tmp_path / "link", session_id="s", clock=ManualClock())
    assert not (tmp_path / "elsewhere").exists()


def test_no_room_for_it_is_stated_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("engine.control.journal.journal.os.posix_fallocate", full)
    with pytest.raises(JournalError, match="No space left"), contextlib.ExitStack():
        TransitionJournal(tmp_path / "ring", session_id="s", clock=ManualClock())
    assert list(tmp_path.iterdir()) == []


def test_a_permit_that_the_watchdog_was_quicker_than_is_taken_back_and_its_fault_reported_once(journal):
    bench = armed_bench([good] * 6, journal=journal)
    bench.beam.before_permit = lambda lease: bench.watchdog.check(lease.expires_ns + 10**10)
    bench.run()
    assert path(journal) == ["hold", "dwell", "fault"]
    assert [change.to_state for change in bench.transitions()] == ["hold", "dwell", "fault"]


def test_a_permit_that_came_too_late_is_committed_before_the_fault_that_took_it_back(journal):
    limits = replace(LIMITS, max_latency_ms=100.0, camera_latency_ms=60.0)
    bench = armed_bench([good] * 6, limits=limits, journal=journal)
    bench.beam.before_permit = lambda lease: bench.clock.advance_ns(40 * MS if lease.sequence == 1 else 0)
    bench.run()
    assert path(journal) == ["hold", "dwell", "beam_on", "fault"]
