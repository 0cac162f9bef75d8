"""What `tidegate serve` does to its own process."""

import contextlib
import gc

import anyio
from sqlalchemy import text

from service.app import create_app
from service.cli.serve import _set_memory_aside
from service.db.engine import Database
from service.db.migrating import MigrationError
from service.db.place import DATABASE_NAME
from service.settings import Settings


def test_what_was_there_at_the_start_is_collected_no_more():
    before, kept = gc.get_freeze_count(), [[] for _ in range(1000)]
    assert any(item is kept for item in gc.get_objects())
    _set_memory_aside()
    assert gc.get_freeze_count() > before + len(kept)
    assert not any(item is kept for item in gc.get_objects())


def test_a_database_of_a_newer_version_is_refused_in_one_line(tmp_path):
    (tmp_path / "data").mkdir(mode=0o700)
    database = Database(tmp_path / "data" / DATABASE_NAME)
    database.migrate()
    with database.write() as db:
        db.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    app = create_app(Settings(data_dir=tmp_path / "data"))
    said = list(anyio.run(_started, app))
    assert [message["type"] for message in said] == ["lifespan.startup.failed"]
    assert said[0]["message"].startswith("nothing was started: the database is at revision 9999")
    assert "\n" not in said[0]["message"]


async def _started(app):
    said = []

    async def receive():
        return {"type": "lifespan.startup"}

    async def send(message):
        said.append(message)

    with contextlib.suppress(MigrationError):  # the server hears of it by the message
        await app({"type": "lifespan", "asgi": {"version": "3.0"}, "state": {}}, receive, send)
    return said
