"""How Alembic reaches the database: the service's own connection, or a file named with ``-x database=FILE``."""

from pathlib import Path

from alembic import context

from service.db import models
from service.db.engine import Database


def _run(connection) -> None:
    # SQLite can undo DDL, and our connections begin transactions themselves: a migration happens whole or not at all.
    context.configure(connection=connection, target_metadata=models.Base.metadata, transactional_ddl=True)
    with context.begin_transaction():
        context.run_migrations()


def _run_on_file(path: Path) -> None:
    database = Database(path)
    with database.connect() as connection:
        _run(connection)
    database.close()


if context.config.attributes.get("connection") is not None:
    _run(context.config.attributes["connection"])
else:
    _run_on_file(Path(context.get_x_argument(as_dictionary=True)["database"]))
