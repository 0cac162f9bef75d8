"""The journal's file, byte by byte: what a header and a slot must be, and that texts come back as they were."""

import zlib
from dataclasses import replace

import pytest

from engine.control.journal import format as journal_format
from engine.control.journal.format import (
    HEADER_BYTES,
    MAX_SLOTS,
    SLOT_BYTES,
    JournalFormatError,
    JournalHeader,
    file_size,
    pack_slot,
    read_header,
    read_journal,
    slot_offset,
)
from engine.control.journal.journal import TransitionJournal, boot_id
from engine.core.clock import ManualClock
from engine.core.gate_state import HoldReason
from tests.support.control.transitions import transition

HEADER = JournalHeader(session_id="session X", boot_id="boot X", anchor_utc_us=7, anchor_ns=9, slots=4)


def file_of(header=HEADER, *slots, length=None):
    """A journal's file with these slots, as long as its header says or as asked for."""
    content = header.pack().ljust(HEADER_BYTES, b"\0") + b"".join(slots)
    return content.ljust(file_size(header.slots) if length is None else length, b"\0")


def packed(number, at_ns=7, *, prepared=0, is_committed=True, **changes):
    return pack_slot(number, transition(at_ns, **changes), prepared=prepared, is_committed=is_committed)


def checked(body):
    """These bytes behind their checksum."""
    return zlib.crc32(body).to_bytes(4, "little") + body


def test_a_header_comes_back_as_it_was():
    assert read_header(file_of()) == HEADER


@pytest.mark.parametrize("slots", [1, MAX_SLOTS])
def test_a_journal_has_at_least_one_slot_and_at_most_its_bound(slots):
    header = replace(HEADER, slots=slots)
    assert read_header(file_of(header)) == header


@pytest.mark.parametrize("slots", [0, MAX_SLOTS + 1])
def test_a_header_with_another_number_of_slots_is_refused(slots):
    with pytest.raises(JournalFormatError, match=f"^{slots} slots do not fit a file of [0-9]+ bytes$"):
        read_header(file_of(replace(HEADER, slots=slots)))


def test_a_file_of_another_length_than_its_slots_is_refused():
    with pytest.raises(JournalFormatError, match=f"^4 slots do not fit a file of {HEADER_BYTES + SLOT_BYTES} bytes$"):
        read_header(file_of(length=HEADER_BYTES + SLOT_BYTES))
    with pytest.raises(JournalFormatError, match=r"^the file is too short for a header$"):
        read_header(HEADER.pack()[:-1])


@pytest.mark.parametrize("field", [0, 1], ids=["magic", "slot size"])
def test_a_header_of_another_format_is_refused_though_its_checksum_is_right(field):
    fields = list(journal_format._HEADER.unpack(HEADER.pack()[4:]))
    fields[field] = b"TGJRNL99" if field == 0 else SLOT_BYTES * 2
    body = journal_format._HEADER.pack(*fields)
    with pytest.raises(JournalFormatError, match=r"^the header's checksum or format is another$"):
        read_header(checked(body).ljust(file_size(4), b"\0"))


def test_a_header_whose_names_are_no_text_is_refused():
    fields = list(journal_format._HEADER.unpack(HEADER.pack()[4:]))
    fields[3] = b"\xff\xfe"
    with pytest.raises(JournalFormatError, match=r"^the header's names are no text$"):
        read_header(checked(journal_format._HEADER.pack(*fields)).ljust(file_size(4), b"\0"))


def test_an_oldest_number_that_is_missing_in_a_full_ring_is_named():
    slots = [packed(number) for number in (2, 3, 4)]
    assert read_journal(file_of(HEADER, b"\0" * SLOT_BYTES, *slots)).missing_numbers == (1,)
    assert read_journal(file_of()).missing_numbers == ()


def test_a_committed_entry_that_was_not_prepared_cancels_no_other():
    found = read_journal(file_of(HEADER, packed(1, 5, is_committed=False), packed(2, 6)))
    assert [(entry.transition.at_ns, entry.is_committed) for entry in found.entries] == [(5, False), (6, True)]


def test_texts_come_back_whole_up_to_their_bound():
    longest, marked = "x" * journal_format._OPERATOR_BYTES, "Schw. X"
    found = read_journal(file_of(HEADER, packed(1, operator=longest, armed_by=marked, reason=HoldReason.DWELL)))
    (entry,) = found.entries
    assert (entry.transition.operator, entry.transition.armed_by) == (longest, marked)


def test_text_that_is_damaged_under_a_right_checksum_is_read_with_a_mark():
    slot = packed(1, operator="ANN", armed_by="BOB", detail="why")
    body = slot[4:].replace(b"ANN", b"A\xffN").replace(b"BOB", b"B\xffB")
    (entry,) = read_journal(file_of(HEADER, checked(body))).entries
    assert (entry.transition.operator, entry.transition.armed_by) == ("A\ufffdN", "B\ufffdB")


def test_numbers_go_on_behind_an_aborted_entry_and_an_entry_that_was_not_prepared_resolves_none(tmp_path):
    journal = TransitionJournal(tmp_path / "ring", session_id="s", clock=ManualClock(), slots=8)
    first = journal.prepare(transition(5))
    assert (first, journal.commit(transition(6))) == (1, 2)
    found = read_journal(journal.path.read_bytes())
    assert [entry.is_committed for entry in found.entries] == [False, True]
    journal.abort(transition(5), first)
    assert journal.commit(transition(7)) == 4
    content = journal.path.read_bytes()
    assert read_journal(content).missing_numbers == ()
    assert any(content[slot_offset(3, 8) :][:SLOT_BYTES])
    journal.path.unlink()
    journal.acknowledge(4)
    journal.close()


def test_a_system_without_a_boot_id_has_an_empty_one(tmp_path, monkeypatch):
    monkeypatch.setattr("engine.control.journal.journal.BOOT_ID", tmp_path / "none")
    assert boot_id() == ""
