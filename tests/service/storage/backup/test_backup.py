"""Backups: all of it or nothing, from either database into either, proved; and nothing restored over anything."""

import json
import zipfile
from contextlib import closing

import pytest
from sqlalchemy import text

from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.check import check_whole
from service.storage.backup import restore
from service.storage.backup.archive import opened
from service.storage.backup.backup import make_backup, needed_bytes, refuse_full_disk
from service.storage.backup.layout import BackupError, BrokenLogError, Manifest, OtherRoomError
from service.storage.backup.restore import check
from service.storage.backup.rows import digest_of, tables_of
from service.storage.database.engine import Database
from tests.support.database.backups import (
    FILES,
    OTHERS,
    Silent,
    backed_up,
    fill_folder,
    restored,
    rows_at,
    source_of,
    write_rows,
)
from tests.support.database.rows import add_rows, tables
from tests.support.database.second_revision import FIRST

pytestmark = [pytest.mark.long, pytest.mark.slow]

KINDS = ("sqlite", "postgresql")


@pytest.fixture
def places(tmp_path, request):
    """Make empty databases of a kind."""
    made = []

    def make(kind):
        if kind == "sqlite":
            made.append(None)
            return tmp_path / f"{len(made)}.db"
        server = request.getfixturevalue("postgres_server")
        made.append((server, server.empty()))
        return made[-1][1]

    yield make
    for server, url in filter(None, made):
        server.drop(url)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "data").mkdir()
    return tmp_path / "data"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "all.backup"


@pytest.fixture
def made(database, folder, out):
    return backed_up(database, folder, out)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("other_kind", KINDS)
def test_a_backup_of_either_database_is_restored_into_either_row_by_row(
    places, folder, out, tmp_path, kind, other_kind
):
    place, other = places(kind), places(other_kind)
    with closing(Database(place)) as database:
        database.migrate()
        made = backed_up(database, folder, out)
    restored(out, other, tmp_path / "new")
    before, after = rows_at(place), rows_at(other)
    reported = after["audit"].pop()
    assert before.pop("logins")
    assert after.pop("logins") == []
    assert after == before
    assert (reported["action"], reported["actor"]) == ("backup.restored", "me")
    assert json.loads(reported["detail"])["rows"] == made.manifest.rows == sum(map(len, before.values()))
    assert {name: (tmp_path / "new" / name).read_bytes() for name in FILES} == FILES
    assert not [name for name in OTHERS if (tmp_path / "new" / name).exists()]


@pytest.mark.both_databases
def test_a_restored_database_keeps_its_triggers_its_chain_and_its_place_among_the_heads(made, out, place, tmp_path):
    new = tmp_path / "new"
    restored(out, new / "tidegate.db", new)
    with closing(Database(new / "tidegate.db")) as database:
        found = check_whole(database, AnchorFile(new / "anchors.jsonl"))
        assert found.is_intact, found.detail
        assert found.rows == made.manifest.audit_rows + 1
        with pytest.raises(Exception, match="append-only"), database.write() as db:
            db.execute(text("UPDATE audit SET actor = 'you'"))


def test_a_restore_on_the_same_machine_is_distinguished_from_rows_cut_off(database, made, out, folder, tmp_path):
    write_rows(database)
    with database.read() as db:
        later = audit.verify(db)
    heads = AnchorFile(folder / "anchors.jsonl")
    heads.append("stop", sequence=later.rows, head_hash=later.head_hash)
    (tmp_path / "tidegate.db").rename(tmp_path / "lost.db")
    restored(out, folder / "tidegate.db", folder)
    with closing(Database(folder / "tidegate.db")) as new:
        found = check_whole(new, heads)
    assert found.is_intact, found.detail
    assert any("restored" in note for note in found.notes)


@pytest.mark.both_databases
def test_a_backup_sees_one_moment_while_others_go_on_writing(database, folder, out, monkeypatch):
    write_rows(database)
    seen = []

    class Busy(Silent):
        def begin(self, what, _total):
            seen.append(what)
            with closing(Database(database.place)) as other, other.write() as db:
                audit.append(db, Event(actor="me", action="meanwhile"))

    made = make_backup(source_of(database, folder), out, Busy())
    assert len(seen) > 10
    restored(out, folder / "new.db", folder / "new")
    with closing(Database(folder / "new.db")) as new, new.read() as db:
        assert audit.verify(db).rows == made.manifest.audit_rows + 1 == 6


def test_a_file_that_grows_while_it_is_copied_is_in_as_it_was_and_one_that_goes_is_not(database, folder, out):
    stream, gone = folder / "samples/4567.arrows", folder / "models/ab12.npz"

    class Busy(Silent):
        def begin(self, what, _total):
            if what == "samples":
                with stream.open("ab") as file:
                    file.write(b"more")
            elif what.startswith("table audit"):
                gone.unlink()

    write_rows(database)
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    made = make_backup(source_of(database, folder), out, Busy())
    assert "models/ab12.npz" not in {file.path for file in made.manifest.files}
    restored(out, folder / "new.db", folder / "new")
    assert (folder / "new/samples/4567.arrows").read_bytes().startswith(FILES["samples/4567.arrows"])


class Closing(Silent):
    """A session is closed after its stream was listed and before its turn."""

    def __init__(self, folder):
        self._stream = folder / "samples/4567.arrows"

    def begin(self, what, _total):
        if what == "models" and self._stream.exists():
            self._stream.with_suffix(".parquet").write_bytes(b"all of it")
            self._stream.unlink()


def test_a_session_that_closes_while_files_are_copied_is_in_as_it_was_closed(database, folder, out, tmp_path):
    write_rows(database)
    fill_folder(folder)
    made = make_backup(source_of(database, folder), out, Closing(folder))
    names = [file.path for file in made.manifest.files]
    assert "samples/4567.parquet" in names
    assert len(set(names)) == len(names)
    restored(out, tmp_path / "new.db", tmp_path / "new")
    assert (tmp_path / "new/samples/4567.parquet").read_bytes() == b"all of it"


@pytest.mark.both_databases
def test_sessions_without_their_samples_are_named_unless_they_were_removed_for_good(database, folder, out):
    with database.write() as db:
        connection = db.connection()
        others = tuple(table.name for table in tables(connection) if table.name not in ("calibrations", "sessions"))
        for _ in range(4):
            add_rows(connection, but=others)
        ids = db.scalars(text("SELECT id FROM sessions ORDER BY id")).all()
        db.execute(text("UPDATE sessions SET started_at = NULL WHERE id = :id"), {"id": ids[0]})
        audit.append(db, Event(actor="me", action="samples.removed", session_id=ids[1]))
        db.execute(text("UPDATE sessions SET id = '4567' WHERE id = :id"), {"id": ids[2]})
    fill_folder(folder)
    made = make_backup(source_of(database, folder), out, Silent())
    assert made.manifest.without_samples == [ids[3]]


def test_raw_recordings_are_in_it_where_asked_for_and_its_absence_is_stated(database, folder, out, tmp_path):
    made = backed_up(database, folder, out, has_raw=True)
    assert "raw/0123.oni" in {file.path for file in made.manifest.files}
    without = make_backup(source_of(database, folder), tmp_path / "small", Silent())
    assert without.manifest.left_out == ["logins", "raw"]


def test_it_is_its_owner_s_alone_and_written_over_nothing(made, out, database, folder):
    assert out.stat().st_mode & 0o777 == 0o600
    assert not list(out.parent.glob("*.partial"))
    with pytest.raises(BackupError, match="exists already"):
        make_backup(source_of(database, folder), out, Silent())


def test_what_cannot_be_finished_leaves_nothing(database, folder, tmp_path):
    class Full(Silent):
        def begin(self, what, _total):
            if what == "table audit":
                raise OSError(28, "No space left on device")

    write_rows(database)
    with pytest.raises(BackupError, match="No space left"):
        make_backup(source_of(database, folder), tmp_path / "all.backup", Full())
    assert not list(tmp_path.glob("all.backup*"))


def test_a_backup_that_would_fill_the_disk_is_not_begun(made, out):
    refuse_full_disk(out, 0, 0.0)
    with pytest.raises(BackupError, match="have to stay free"):
        refuse_full_disk(out, 2**60, 200.0)


@pytest.mark.both_databases
def test_the_room_it_needs_is_estimated_from_above(database, folder, out):
    made = backed_up(database, folder, out)
    assert needed_bytes(source_of(database, folder)) >= made.size_bytes / 2


@pytest.mark.both_databases
def test_nothing_is_restored_into_a_database_that_has_tables(made, out, place, tmp_path):
    before = rows_at(place)
    with pytest.raises(BackupError, match="not empty"):
        restored(out, place, tmp_path / "new")
    assert rows_at(place) == before
    assert not (tmp_path / "new" / "models").exists()


def test_a_file_that_is_there_already_and_another_is_not_written_over(made, out, tmp_path):
    there = tmp_path / "new/models/ab12.npz"
    there.parent.mkdir(parents=True)
    there.write_bytes(b"another patient's")
    with pytest.raises(BackupError, match="there already, and another"):
        restored(out, tmp_path / "new.db", tmp_path / "new")
    assert there.read_bytes() == b"another patient's"
    assert rows_at(tmp_path / "new.db") == {}


def test_a_restore_that_was_cut_off_begins_again_over_the_files_it_left(made, out, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(restore, "_restore_rows", _killed)
        with pytest.raises(RuntimeError):
            restored(out, tmp_path / "new.db", tmp_path / "new")
    assert rows_at(tmp_path / "new.db") == {}
    restored(out, tmp_path / "new.db", tmp_path / "new")
    assert len(rows_at(tmp_path / "new.db")["audit"]) == 6


def _killed(*_arguments):
    raise RuntimeError


def rewritten(path, change):
    """Write a backup anew with its entries changed: ``change(name, content)``, None leaves one out."""
    with zipfile.ZipFile(path) as archive:
        entries = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries:
            new = change(name, content)
            if new is not None:
                archive.writestr(name, new)


def _other_table(name, content):
    return content.replace(b"cam", b"cum") if name == "tables/calibrations.jsonl" else content


def _without_model(name, content):
    return None if name.startswith("models/") else content


def _other_model(name, content):
    return b"b" + content[1:] if name.startswith("models/") else content


def _without_manifest(name, content):
    return None if name == "manifest.json" else content


def _with(field, value):
    def change(name, content):
        return json.dumps(json.loads(content) | {field: value}) if name == "manifest.json" else content

    return change


def _leading_elsewhere(name, content):
    return content.replace(b"models/ab12.npz", b"models/../x.npz") if name == "manifest.json" else content


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_other_table, "table calibrations of the backup differs from its manifest"),
        (_without_model, r"models/ab12\.npz is missing"),
        (_other_model, r"models/ab12\.npz of the backup differs from its manifest"),
        (_without_manifest, "no backup of ours"),
        (_with("schema", "tidegate.backup/2"), "of a newer version"),
        (_with("revision", "9999"), "made by a newer version"),
        (_with("tables", []), "tables are not those of revision"),
        (_with("more", 1), "no backup of ours"),
        (_leading_elsewhere, "names a file that no backup of ours holds"),
    ],
)
def test_a_backup_that_was_changed_is_refused_and_leaves_no_row(made, out, tmp_path, change, words):
    rewritten(out, change)
    with pytest.raises(BackupError, match=words):
        restored(out, tmp_path / "new.db", tmp_path / "new")
    assert not (tmp_path / "new.db").exists() or rows_at(tmp_path / "new.db") == {}


def test_a_backup_cut_off_anywhere_is_refused(made, out, tmp_path):
    content = out.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9, 0.999):
        out.write_bytes(content[: int(share * len(content))])
        with pytest.raises(BackupError, match="was cut off"):
            restored(out, tmp_path / "new.db", tmp_path / "new")


def test_flipped_bytes_anywhere_are_found(made, out, tmp_path):
    content = out.read_bytes()
    for place in range(100, len(content) - 100, len(content) // 12):
        out.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            with opened(out) as backup:
                check(backup, tmp_path, Silent())
        except BackupError:
            continue
        with opened(out) as backup:  # what no reading looks at: a name in a local header, a time
            assert backup.manifest == made.manifest


def test_rows_that_did_not_arrive_as_they_were_are_found_before_anything_is_kept(made, out, tmp_path, monkeypatch):
    add_lines = restore.add_lines

    def forgetful(connection, table, part, source, on_rows):
        lines = list(source)
        add_lines(connection, table, part, lines[:-1] if table.name == "idempotency_keys" else lines, on_rows)

    monkeypatch.setattr(restore, "add_lines", forgetful)
    with pytest.raises(BackupError, match="idempotency_keys was not restored as it was"):
        restored(out, tmp_path / "new.db", tmp_path / "new")
    assert rows_at(tmp_path / "new.db") == {}


def test_a_check_leaves_nothing_behind(made, out, tmp_path):
    before = sorted(tmp_path.iterdir())
    with opened(out) as backup:
        check(backup, tmp_path, Silent())
    assert sorted(tmp_path.iterdir()) == before


def test_a_log_that_was_broken_before_is_restored_only_on_confirmation(database, folder, out, tmp_path):
    write_rows(database)
    with database.write() as db:
        db.execute(text("DROP TRIGGER audit_no_update"))
        db.execute(text("UPDATE audit SET actor = 'you' WHERE sequence = 3"))
    make_backup(source_of(database, folder), out, Silent())
    with pytest.raises(BrokenLogError, match="row 3"):
        restored(out, tmp_path / "new.db", tmp_path / "new")
    assert rows_at(tmp_path / "new.db") == {}
    restored(out, tmp_path / "new.db", tmp_path / "new", takes_broken_log=True)
    reported = json.loads(rows_at(tmp_path / "new.db")["audit"][-1]["detail"])
    assert "row 3" in reported["audit_trouble"]


@pytest.mark.both_databases
@pytest.mark.usefixtures("second")
def test_a_backup_of_older_tables_is_brought_up_to_this_version_s(empty_place, folder, out, tmp_path):
    with closing(Database(empty_place)) as database:
        database.migrate(FIRST)
        with database.write() as db:
            db.execute(text("INSERT INTO qa_baselines VALUES (1, '{}', 'me', 'why', '2026-01-01T00:00:00.000000Z')"))
        made = make_backup(source_of(database, folder), out, Silent())
    assert made.manifest.revision == FIRST
    restored(out, tmp_path / "new.db", tmp_path / "new")
    with closing(Database(tmp_path / "new.db")) as database:
        database.migrate()
    assert rows_at(tmp_path / "new.db")["qa_baselines"][0]["set_by"] == "me"
    assert rows_at(tmp_path / "new.db")["made_up"] == []


def test_every_column_there_is_has_a_type_that_backups_know(made):
    assert isinstance(made.manifest, Manifest)
    assert {table.name for table in made.manifest.tables} >= {"audit", "sessions", "users", "api_keys", "qa_results"}


def test_rows_have_one_order_whatever_a_server_thinks_of_letters(places):
    parts = []
    for kind in KINDS:
        with closing(Database(places(kind))) as database:
            database.migrate()
            with database.write() as db:
                for key in ("b", "A", "a", "_", "B", "ä", "a-1", "a1"):
                    row = "INSERT INTO idempotency_keys VALUES ('r', :key, 'h', '{}', '2026-01-01')"
                    db.execute(text(row), {"key": key})
                connection = db.connection()
                table = next(one for one in tables_of(connection) if one.name == "idempotency_keys")
                parts.append(digest_of(connection, table, lambda _rows: None))
    assert parts[0] == parts[1]


@pytest.mark.parametrize(("made_in", "restored_in"), [("1", "2"), ("1", ""), ("", "2")])
def test_another_room_s_backup_is_taken_only_where_that_is_stated(
    database, folder, out, tmp_path, made_in, restored_in
):
    backed_up(database, folder, out, room=made_in)
    with opened(out) as found, closing(Database(tmp_path / "new.db")) as new:
        assert found.manifest.room == made_in
        target = restore.Target(
            database=new, data_dir=tmp_path / "new", anchor_file=tmp_path / "new.jsonl", room=restored_in
        )
        told = {"actor": "me", "name": "all.backup", "progress": Silent()}
        with pytest.raises(OtherRoomError, match="TIDEGATE_ROOM"):
            restore.restore(found, target, **told)
        assert not (tmp_path / "new").exists()
        restore.restore(found, target, takes_other_room=True, **told)
        with new.read() as db:
            rows = db.execute(text("SELECT detail FROM audit WHERE action = 'backup.restored'")).scalars().all()
    assert json.loads(rows[-1])["room"] == made_in
