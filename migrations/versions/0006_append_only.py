"""What is only ever added to stays as it was, by every way round the triggers there is; calibrations and models too.

0001 and 0005 refuse UPDATE and DELETE on the audit and on QA's tables. Three ways round were left:

* SQLite: `INSERT OR REPLACE` removes the row in its way without firing a DELETE trigger. The triggers on INSERT look
  for a row of the same key; a row of the same hidden `rowid` under another key was not looked for.
* PostgreSQL: TRUNCATE fires no row's trigger.
* PostgreSQL: `session_replication_role = replica` leaves ordinary triggers out, so all of them become ALWAYS triggers.
"""

import sqlalchemy as sa
from alembic import op

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
"""Tables whose `rowid` is no column of theirs; it can be named in an INSERT all the same."""
SEALED = ("audit", "calibrations", "models", "qa_runs", "qa_outcomes", "qa_results", "qa_baselines")


def upgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        for name, body in _sqlite_triggers().items():
            op.execute(f"CREATE TRIGGER {name} {body}")
        return
    for table, same in KEYS.items():
        _forbid(table, "no_update", "UPDATE", "FOR EACH ROW")
        _forbid(table, "no_delete", "DELETE", "FOR EACH ROW")
        _forbid_same(table, same)
    for table in SEALED:
        _forbid(table, "no_truncate", "TRUNCATE", "FOR EACH STATEMENT")
    _make_triggers("ALWAYS ")


def downgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        for name in _sqlite_triggers():
            op.execute(f"DROP TRIGGER {name}")
        return
    for table in SEALED:
        names = ("no_truncate", *(("no_update", "no_delete", "only_new") if table in KEYS else ()))
        for name in names:
            op.execute(f"DROP TRIGGER {table}_{name} ON {table}")
            op.execute(f"DROP FUNCTION {table}_{name}()")
    _make_triggers("")


def _sqlite_triggers() -> dict[str, str]:
    made = {}
    for table, same in KEYS.items():
        for verb in ("UPDATE", "DELETE"):
            made[f"{table}_no_{verb.lower()}"] = f"BEFORE {verb} ON {table} {_refusal(table)}"
        made[f"{table}_only_new"] = _unless_there(table, same)
    for table in HIDDEN:
        made[f"{table}_only_new_rowid"] = _unless_there(table, "rowid = NEW.rowid")
    return made


def _unless_there(table: str, same: str) -> str:
    there = f"EXISTS (SELECT 1 FROM {table} WHERE {same})"  # noqa: S608 - names of this file alone
    return f"BEFORE INSERT ON {table} WHEN {there} {_refusal(table)}"


def _refusal(table: str) -> str:
    return f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"


def _forbid(table: str, name: str, verb: str, each: str) -> None:
    words = "the audit log" if table == "audit" else table
    op.execute(
        f"CREATE FUNCTION {table}_{name}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        f"RAISE EXCEPTION '{words} is append-only' USING ERRCODE = 'integrity_constraint_violation'; END $$"
    )
    op.execute(f"CREATE TRIGGER {table}_{name} BEFORE {verb} ON {table} {each} EXECUTE FUNCTION {table}_{name}()")


def _forbid_same(table: str, same: str) -> None:
    """Refuse a row that is there already before any ON CONFLICT is looked at."""
    op.execute(
        f"CREATE FUNCTION {table}_only_new() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "  # noqa: S608 - as above
        f"IF EXISTS (SELECT 1 FROM {table} WHERE {same}) THEN RAISE EXCEPTION '{table} is append-only' "
        "USING ERRCODE = 'integrity_constraint_violation'; END IF; RETURN NEW; END $$"
    )
    op.execute(
        f"CREATE TRIGGER {table}_only_new BEFORE INSERT ON {table} FOR EACH ROW EXECUTE FUNCTION {table}_only_new()"
    )


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
