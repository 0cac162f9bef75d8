"""A made-up revision of the tables after the last real one: upgrades and downgrades are tested with it."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import migrations as package
from service.storage.database import migrations

FIRST, SECOND = "0003", "0004"
TITLE = "Made up: a table, and a column of the sessions."
SCRIPT = f'''"""{TITLE}"""

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, fix_search_path, refuse

revision = "{SECOND}"
down_revision = "{FIRST}"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table("made_up", sa.Column("id", sa.String(32), primary_key=True), sa.Column("value", sa.Double))
    op.add_column("sessions", sa.Column("made_up", sa.Text, nullable=False, server_default="{{}}"))
    refuse("made_up_no_delete", "made_up", "DELETE", None, "made_up is append-only")
    fix_search_path()


def downgrade() -> None:
    allow("made_up_no_delete", "made_up")
    op.drop_column("sessions", "made_up")
    op.drop_table("made_up")
'''


@contextmanager
def second_revision(folder: Path) -> Iterator[None]:
    """Have this process know a further revision, written into ``folder``."""
    scripts = folder / "migrations"
    shutil.copytree(Path(package.__path__[0]), scripts, ignore=shutil.ignore_patterns("__pycache__"))
    (scripts / "versions" / f"{SECOND}_made_up.py").write_text(SCRIPT, encoding="utf-8")
    files = migrations.files
    migrations.files = lambda _package: scripts  # type: ignore[assignment]
    migrations._scripts.cache_clear()
    try:
        yield
    finally:
        migrations.files = files
        migrations._scripts.cache_clear()
