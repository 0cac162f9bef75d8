"""A data folder with something of everything in it, and its way into a backup and back."""

from contextlib import closing
from pathlib import Path

from sqlalchemy import URL

from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.anchors import AnchorFile
from service.storage.backup.archive import opened
from service.storage.backup.backup import CreatedBackup, Source, make_backup
from service.storage.backup.restore import Target, restore
from service.storage.database.engine import Database
from tests.support.database.rows import Contents, add_rows, contents

FILES = {
    "models/ab12.npz": b"a model" * 1000,
    "samples/0123.parquet": b"samples" * 1000,
    "samples/4567.arrows": b"a stream that is still written",
    "replays/0123.tape": b"a tape",
}
OTHERS = {"samples/89.parquet.partial": b"half", "raw/0123.oni": b"frames", "recordings/site.oni": b"the site's own"}


class Silent:
    """No one looks on."""

    def begin(self, what: str, _total: int, /) -> None:
        """Do nothing."""

    def advance(self, done: int) -> None:
        """Do nothing."""


def write_rows(database: Database, events: int = 5) -> None:
    """Add a row to every table, the audit's in a whole chain."""
    with database.write() as db:
        add_rows(db.connection(), but=("audit",))
        for number in range(events):
            audit.append(db, Event(actor="me", action="test", detail={"number": number, "text": "Grüße ☢"}))


def fill_folder(folder: Path) -> None:
    """Lay files of every kind into a data folder."""
    for name, content in (FILES | OTHERS).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def source_of(database: Database, folder: Path, **wishes: bool) -> Source:
    return Source(database=database, data_dir=folder, anchor_file=folder / "anchors.jsonl", **wishes)


def backed_up(database: Database, folder: Path, out: Path, **wishes: bool) -> CreatedBackup:
    """Fill a database and its folder, and back both up."""
    write_rows(database)
    fill_folder(folder)
    with database.read() as db:
        found = audit.verify(db)
    AnchorFile(folder / "anchors.jsonl").append("stop", sequence=found.rows, head_hash=found.head_hash)
    return make_backup(source_of(database, folder, **wishes), out, Silent())


def restored(path: Path, place: Path | URL, folder: Path, **wishes: bool) -> None:
    """Restore a backup."""
    folder.mkdir(exist_ok=True)
    with closing(Database(place, answer_timeout_s=None)) as database, opened(path) as backup:
        target = Target(database=database, data_dir=folder, anchor_file=folder / "anchors.jsonl")
        restore(backup, target, actor="me", name=path.name, progress=Silent(), **wishes)


def rows_at(place: Path | URL) -> Contents:
    """Read all rows."""
    with closing(Database(place)) as database, database.connect() as connection:
        return contents(connection)
