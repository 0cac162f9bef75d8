"""What somebody did to the log is named, with the first row it touched."""

import pytest

from service.storage import audit
from service.storage.audit import Breakage
from service.storage.audit.chain import GENESIS_HASH, Link
from service.storage.audit.verification import Head, Walk, pieces, read_links, verify_pieces
from tests.support.audit.rows import fill

COLUMNS = ", ".join(Link._fields)


def verified(database, heads=()):
    with database.read() as db:
        return audit.verify(db, heads)


def links_of(database):
    with database.read() as db:
        return read_links(db, None, 100)


def links_of_raw(raw):
    return [Link._make(row) for row in raw.execute(f"SELECT {COLUMNS} FROM audit ORDER BY sequence")]


def reseal(raw, start=1):
    """Seal every row anew from a place on, as somebody would who knows how."""
    before = GENESIS_HASH
    for link in links_of_raw(raw):
        row = link
        if link.sequence >= start:
            row = link._replace(previous_hash=before)
            row = row._replace(hash=audit.seal(row))
            raw.execute("UPDATE audit SET previous_hash=?, hash=? WHERE sequence=?", (before, row.hash, row.sequence))
        before = row.hash
    raw.commit()


def renumber(raw, first, step):
    order = "DESC" if step > 0 else "ASC"
    found = raw.execute(f"SELECT sequence FROM audit WHERE sequence >= {first} ORDER BY sequence {order}").fetchall()
    for (number,) in found:
        raw.execute("UPDATE audit SET sequence = ? WHERE sequence = ?", (number + step, number))
    raw.commit()


@pytest.mark.parametrize("sequence", [1, 4, 7])
def test_a_changed_row_is_called_changed(database, raw, sequence):
    raw.execute("UPDATE audit SET actor = 'you' WHERE sequence = ?", (sequence,))
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence, found.rows) == (Breakage.CHANGED, sequence, sequence - 1)


def test_a_changed_row_that_was_sealed_again_breaks_the_next_one(database, raw):
    raw.execute("UPDATE audit SET actor = 'you' WHERE sequence = 3")
    (row,) = [link for link in links_of_raw(raw) if link.sequence == 3]
    raw.execute("UPDATE audit SET hash = ? WHERE sequence = 3", (audit.seal(row),))
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.RESEALED, 4)


def test_a_row_taken_out_is_called_missing(database, raw):
    raw.execute("DELETE FROM audit WHERE sequence = 4")
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.MISSING, 5)


def test_a_row_taken_out_and_the_rest_renumbered_is_called_missing(database, raw):
    raw.execute("DELETE FROM audit WHERE sequence = 4")
    renumber(raw, 5, -1)
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.MISSING, 4)


def test_a_row_put_in_between_is_called_inserted(database, raw):
    renumber(raw, 4, 1)
    before = links_of_raw(raw)[2]
    new = before._replace(sequence=4, actor="you", previous_hash=before.hash)
    raw.execute("INSERT INTO audit VALUES (?,?,?,?,?,?,?,?,?)", new._replace(hash=audit.seal(new)))
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.INSERTED, 5)


def test_a_row_before_the_first_one_is_called_inserted(database, raw):
    (first, *_) = links_of_raw(raw)
    raw.execute("INSERT INTO audit VALUES (?,?,?,?,?,?,?,?,?)", first._replace(sequence=-5))
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.INSERTED, -5)


def test_rows_that_changed_places_are_called_reordered(database, raw):
    for old, new in ((3, -1), (4, 3), (-1, 4)):
        raw.execute("UPDATE audit SET sequence = ? WHERE sequence = ?", (new, old))
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.REORDERED, 3)


def test_a_row_that_holds_what_no_row_can_is_called_changed(database, raw):
    raw.execute("UPDATE audit SET detail = x'ff00' WHERE sequence = 2")
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.CHANGED, 2)


@pytest.mark.parametrize("sequence", [1, 4, 7])
@pytest.mark.parametrize("column", ["actor", "detail", "hash"])
def test_a_row_of_bytes_that_are_no_text_is_called_changed(database, raw, sequence, column):
    raw.execute(f"UPDATE audit SET {column} = CAST(x'61ff62' AS TEXT) WHERE sequence = ?", (sequence,))
    raw.commit()
    found = verified(database)
    assert (found.breakage, found.first_broken_sequence, found.rows) == (Breakage.CHANGED, sequence, sequence - 1)


def test_newest_rows_cut_off_are_missed_by_a_head_kept_elsewhere(database, raw):
    kept = [Head(link.sequence, link.hash, link.at) for link in links_of(database) if link.sequence in {2, 6}]
    raw.execute("DELETE FROM audit WHERE sequence > 4")
    raw.commit()
    assert verified(database).is_intact
    found = verified(database, kept)
    assert (found.breakage, found.first_broken_sequence, found.rows) == (Breakage.CUT_OFF, 5, 4)
    assert found.detail.startswith("rows 5 to 6 are missing at the end")


def test_a_log_sealed_anew_from_some_row_on_differs_from_the_next_head_kept_elsewhere(database, raw):
    kept = [Head(link.sequence, link.hash, link.at) for link in links_of(database) if link.sequence in {2, 6}]
    raw.execute("UPDATE audit SET actor = 'you' WHERE sequence = 3")
    reseal(raw, 3)
    assert verified(database).is_intact
    found = verified(database, kept)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.REPLACED, 6)


def test_heads_that_fit_change_nothing(database):
    kept = [Head(link.sequence, link.hash, link.at) for link in links_of(database)]
    assert verified(database, kept).is_intact
    assert verified(database, [kept[0], kept[0], kept[6]]).is_intact


def test_a_walk_in_pieces_finds_what_a_walk_at_once_finds(database, raw, monkeypatch):
    monkeypatch.setattr("service.storage.audit.verification.PIECE_ROWS", 3)
    raw.execute("UPDATE audit SET actor = 'you' WHERE sequence = 7")
    raw.commit()
    done = []
    with database.read() as db:
        found = verify_pieces(lambda after, limit: read_links(db, after, limit), on_piece=done.append)
    assert (found.first_broken_sequence, done) == (7, [3, 6])


def test_a_walk_goes_on_from_a_row(database):
    third = links_of(database)[2]
    walk = Walk(after=third)
    assert walk.take(links_of(database)[3:])
    assert (walk.end().rows, walk.last_sequence) == (4, 7)


def test_rows_past_the_end_asked_for_are_left_alone(database):
    with database.read() as db:
        read = list(pieces(lambda after, limit: read_links(db, after, limit), up_to=5))
    read = [link.sequence for links in read for link in links]
    assert read == [1, 2, 3, 4, 5]


def test_an_empty_log_holds_and_ends_where_every_log_begins(tmp_path):
    from service.storage.database.engine import Database

    database = Database(tmp_path / "empty.db")
    database.migrate()
    with database.read() as db:
        found = audit.verify(db)
    database.close()
    assert (found.rows, found.head_hash, found.is_intact) == (0, GENESIS_HASH, True)


def test_more_rows_make_a_longer_chain(database):
    fill(database, 3)
    assert verified(database).rows == 10
