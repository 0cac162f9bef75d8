"""What is only ever added to stays as it was, by every way round the triggers there is; calibrations and models too.

0001 and 0005 refuse UPDATE and DELETE on the audit and on QA's tables. Three ways round were left:

* SQLite: `INSERT OR REPLACE` removes the row in its way without firing a DELETE trigger. The triggers on INSERT look
  for a row of the same key; a row of the same hidden `rowid` under another key was not looked for.
* PostgreSQL: TRUNCATE fires no row's trigger.
* PostgreSQL: `session_replication_role = replica` leaves ordinary triggers out, so all of them become ALWAYS triggers.
"""

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, refuse

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

KEYS = {
    "calibrations": "id = NEW.id OR sha256 = NEW.sha256",
    "models": "id = NEW.id OR (session_id = NEW.session_id AND number = NEW.number)",
}
"""Tables that had no triggers, and what makes a row the same one."""
HIDDEN = ("calibrations", "models", "qa_runs", "qa_outcomes", "qa_results")
"""Tables whose `rowid` in SQLite is no column of theirs; it can be named in an INSERT all the same."""
SEALED = ("audit", "calibrations", "models", "qa_runs", "qa_outcomes", "qa_results", "qa_baselines")


def upgrade() -> None:
    for name, trigger in _triggers().items():
        refuse(name, *trigger)
    if op.get_bind().dialect.name == "postgresql":
        for table in SEALED:
            _refuse_truncate(table)
        _make_triggers("ALWAYS ")


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for table in SEALED:
            allow(f"{table}_no_truncate", table)
        _make_triggers("")
    for name, (table, *_) in _triggers().items():
        allow(name, table)


def _triggers() -> dict[str, tuple[str, str, str | None, str]]:
    """Name each trigger: its table, its verb, when it refuses (None is always), and what it says."""
    made: dict[str, tuple[str, str, str | None, str]] = {}
    for table, same in KEYS.items():
        for verb in ("UPDATE", "DELETE"):
            made[f"{table}_no_{verb.lower()}"] = (table, verb, None, f"{table} is append-only")
        made[f"{table}_only_new"] = _new_only(table, same)
    if op.get_bind().dialect.name == "sqlite":
        made |= {f"{table}_only_new_rowid": _new_only(table, "rowid = NEW.rowid") for table in HIDDEN}
    return made


def _new_only(table: str, same: str) -> tuple[str, str, str | None, str]:
    there = f"EXISTS (SELECT 1 FROM {table} WHERE {same})"  # noqa: S608 - names of this file alone # nosec B608
    return table, "INSERT", there, f"{table} is append-only"


def _refuse_truncate(table: str) -> None:
    name, words = f"{table}_no_truncate", "the audit log" if table == "audit" else table
    op.execute(
        f"CREATE FUNCTION {name}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        f"RAISE EXCEPTION '{words} is append-only' USING ERRCODE = 'integrity_constraint_violation'; END $$"
    )
    op.execute(f"CREATE TRIGGER {name} BEFORE TRUNCATE ON {table} FOR EACH STATEMENT EXECUTE FUNCTION {name}()")


def _make_triggers(always: str) -> None:
    """Let our triggers fire always, or as ordinary ones."""
    found = op.get_bind().execute(
        sa.text(
            "SELECT c.relname, t.tgname FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid "
            "JOIN pg_namespace n ON n.oid = c.relnamespace "
            "WHERE NOT t.tgisinternal AND n.nspname = current_schema() AND c.relname IN :tables"
        ).bindparams(sa.bindparam("tables", value=SEALED, expanding=True))
    )
    for table, name in found.all():
        op.execute(f'ALTER TABLE "{table}" ENABLE {always}TRIGGER "{name}"')
