"""The file of heads: it only grows, shows when it was touched, and shows when the database was."""

import json

import pytest

from service.storage.audit.anchors import AnchorFile, note_restore
from service.storage.audit.chain import GENESIS_HASH
from service.storage.audit.verification import Breakage, read_links, verify_pieces

HASH = "ab" * 32


@pytest.fixture
def file(tmp_path):
    return AnchorFile(tmp_path / "anchors.jsonl")


def lines(file):
    return file.path.read_text().splitlines()


def test_each_line_carries_the_hash_of_the_line_before(file):
    first = file.append("start", sequence=1, head_hash=HASH)
    second = file.append("time", sequence=9, head_hash=HASH)
    assert first.previous == GENESIS_HASH
    assert second.previous not in {GENESIS_HASH, first.previous}
    assert [json.loads(line)["sequence"] for line in lines(file)] == [1, 9]
    assert (file.report().trouble, file.report().lines) == (None, 2)


def test_what_was_there_stays_as_it_was(file):
    before = b""
    for number in range(1, 30):
        file.append("time", sequence=number, head_hash=HASH)
        now = file.path.read_bytes()
        assert now.startswith(before)
        before = now


def test_only_its_owner_may_read_it(file):
    file.append("start", sequence=1, head_hash=HASH)
    assert file.path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("touched", [0, 1])
def test_a_changed_line_breaks_the_next_one(file, touched):
    for number in (1, 2, 3):
        file.append("time", sequence=number, head_hash=HASH)
    changed = lines(file)
    changed[touched] = changed[touched].replace(HASH, "cd" * 32)
    file.path.write_text("\n".join(changed) + "\n")
    assert f"line {touched + 2} of the anchor file does not follow" in file.report().trouble


def test_a_removed_line_breaks_the_next_one(file):
    for number in (1, 2, 3):
        file.append("time", sequence=number, head_hash=HASH)
    file.path.write_text("\n".join([lines(file)[0], lines(file)[2]]) + "\n")
    assert "line 2" in file.report().trouble


def test_a_torn_line_is_ended_reported_and_followed(file):
    file.append("start", sequence=1, head_hash=HASH)
    with file.path.open("ab") as raw:
        raw.write(b'{"at":"2026-')
    assert file.last().sequence == 1
    file.append("time", sequence=2, head_hash=HASH)
    report = file.report()
    assert (report.trouble, report.lines, len(report.notes)) == (None, 3, 1)
    assert "line 2 of the anchor file cannot be read" in report.notes[0]
    assert file.last().sequence == 2


def test_rows_that_go_back_without_a_restore_are_trouble(file):
    file.append("time", sequence=9, head_hash=HASH)
    file.append("start", sequence=4, head_hash=HASH)
    assert "anchors row 4 after row 9" in file.report().trouble


def test_a_restore_is_reported_and_only_what_follows_it_counts(file):
    file.append("time", sequence=9, head_hash=HASH)
    note_restore(file.path, sequence=4, head_hash="cd" * 32, source="backup of Monday")
    report = file.report()
    assert report.trouble is None
    assert report.notes[0].startswith("a backup that ends with row 4 was restored at")
    assert "backup of Monday" in report.notes[0]
    assert [head.sequence for head in file.heads(report.counts_from_byte)] == [4]


def test_a_file_that_was_cut_or_replaced_does_not_reach_where_it_did(file):
    assert file.reached() is None
    file.append("start", sequence=1, head_hash=HASH)
    file.append("time", sequence=2, head_hash=HASH)
    reached = file.reached()
    file.append("time", sequence=3, head_hash=HASH)
    assert file.still_reaches(reached)
    whole = lines(file)
    file.path.write_text(whole[0] + "\n")
    assert not file.still_reaches(reached)
    file.path.write_text("\n".join([whole[0].replace("start", "START"), whole[1].replace("time", "TIME"), whole[2]]))
    assert not file.still_reaches(reached)
    file.path.unlink()
    assert not file.still_reaches(reached)


def test_a_file_of_many_lines_is_reported_from_its_end(file):
    for number in range(1, 600):
        file.append("time", sequence=number, head_hash=HASH)
    assert file.last().sequence == 599
    assert file.still_reaches(file.reached())


def test_a_database_whose_newest_rows_were_cut_off_is_found_by_the_file(database, raw, file):
    with database.read() as db:
        for link in read_links(db, None, 100):
            file.append("time", sequence=link.sequence, head_hash=link.hash)
    raw.execute("DELETE FROM audit WHERE sequence > 5")
    raw.commit()
    with database.read() as db:
        found = verify_pieces(lambda after, limit: read_links(db, after, limit), file.heads())
    assert (found.breakage, found.first_broken_sequence) == (Breakage.CUT_OFF, 6)


def test_a_file_that_cannot_be_written_states_it(tmp_path):
    with pytest.raises(OSError, match="No such file"):
        AnchorFile(tmp_path / "nowhere" / "anchors.jsonl").append("start", sequence=1, head_hash=HASH)
