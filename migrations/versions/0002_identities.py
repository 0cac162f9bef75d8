"""What a fraction was armed with; the spelling of patients, plans and fractions.

Names that differ by spaces, compatibility characters, case or look-alike letters were different patients, plans and
fractions so far. They are named in `identities` with the spelling that they are `like`, and not merged: their rows keep
their text, and what is entered from now on is the first spelling.
"""

from collections.abc import Iterable

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, fix_search_path, make_always, refuse, refuse_truncate
from service.core.identity import identity_key

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

TABLE = "identities"
WORDS = f"{TABLE} is append-only"
KINDS = {"patient": ("patient_reference",), "plan": ("patient_reference", "plan_id")}
KINDS["fraction"] = (*KINDS["plan"], "fraction_id")
SAME = {"only_new": "kind = NEW.kind AND key = NEW.key"}


def upgrade() -> None:
    op.add_column("sessions", sa.Column("fraction_arming", sa.Text))
    op.create_table(
        TABLE,
        sa.Column("kind", sa.String(16), primary_key=True),
        sa.Column("key", sa.String(800), primary_key=True),
        sa.Column("text", sa.String(80), nullable=False),
        sa.Column("like", sa.String(80)),
    )
    table = sa.table(TABLE, *map(sa.column, ("kind", "key", "text", "like")))
    rows = list(_identities(op.get_bind()))
    if rows:
        op.bulk_insert(table, rows)
    for name, trigger in _triggers().items():
        refuse(name, *trigger)
    refuse_truncate(TABLE, WORDS)
    make_always([TABLE])
    fix_search_path()


def _triggers() -> dict[str, tuple[str, str, str | None, str]]:
    made: dict[str, tuple[str, str, str | None, str]] = {
        f"{TABLE}_no_{verb.lower()}": (TABLE, verb, None, WORDS) for verb in ("UPDATE", "DELETE")
    }
    same = dict(SAME)
    if op.get_bind().dialect.name == "sqlite":
        same["only_new_rowid"] = "rowid = NEW.rowid"
    for name, condition in same.items():
        is_there = f"EXISTS (SELECT 1 FROM {TABLE} WHERE {condition})"  # noqa: S608 # nosec B608
        made[f"{TABLE}_{name}"] = (TABLE, "INSERT", is_there, WORDS)
    return made


def _identities(connection: sa.Connection) -> Iterable[dict[str, str | None]]:
    """Yield each spelling, the oldest first: a later one that is like it has its own text as its key."""
    columns = [sa.column(name) for name in (*KINDS["fraction"], "created_at", "id")]
    sessions = sa.select(*columns).select_from(sa.table("sessions")).order_by(*columns[-2:])
    first: dict[tuple[str, str], str] = {}
    seen: set[tuple[str, str]] = set()
    for row in connection.execute(sessions).mappings():
        for kind, names in KINDS.items():
            texts = [str(row[name]) for name in names]
            exact = "\x1f".join(texts)
            if (kind, exact) in seen:
                continue
            seen.add((kind, exact))
            key = (kind, "\x1f".join(map(identity_key, texts)))
            if key not in first:
                first[key] = texts[-1]
                yield {"kind": kind, "key": key[1], "text": texts[-1], "like": None}
            elif first[key] != texts[-1]:
                yield {"kind": kind, "key": "=" + exact, "text": texts[-1], "like": first[key]}


def downgrade() -> None:
    for name, (table, *_) in _triggers().items():
        allow(name, table)
    if op.get_bind().dialect.name == "postgresql":
        allow(f"{TABLE}_no_truncate", TABLE)
    op.drop_table(TABLE)
    op.drop_column("sessions", "fraction_arming")
