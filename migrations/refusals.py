"""Triggers that refuse a change, on both databases.

Used by revisions that are out in the world: what is here may be added to, and not be changed.
"""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

OUR_FUNCTIONS = """
SELECT DISTINCT n.nspname, p.proname FROM pg_trigger t
JOIN pg_class c ON c.oid = t.tgrelid JOIN pg_namespace n ON n.oid = c.relnamespace
JOIN pg_proc p ON p.oid = t.tgfoid AND p.pronamespace = n.oid
WHERE NOT t.tgisinternal AND n.nspname = current_schema() ORDER BY 2
"""

OUR_TRIGGERS = sa.text(
    "SELECT c.relname, t.tgname FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid "
    "JOIN pg_namespace n ON n.oid = c.relnamespace "
    "WHERE NOT t.tgisinternal AND n.nspname = current_schema() AND c.relname IN :tables"
).bindparams(sa.bindparam("tables", expanding=True))


def refuse(name: str, table: str, verb: str, condition: str | None, message: str) -> None:
    """Have the database refuse ``verb`` on ``table``, always or where ``condition`` holds of NEW."""
    if op.get_bind().dialect.name == "sqlite":
        when = "" if condition is None else f"WHEN {condition} "
        op.execute(f"CREATE TRIGGER {name} BEFORE {verb} ON {table} {when}BEGIN SELECT RAISE(ABORT, '{message}'); END")
        return
    raised = f"RAISE EXCEPTION '{message}' USING ERRCODE = 'integrity_constraint_violation';"
    checked = raised if condition is None else f"IF {condition} THEN {raised} END IF;"
    row = "OLD" if verb == "DELETE" else "NEW"
    op.execute(f"CREATE FUNCTION {name}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN {checked} RETURN {row}; END $$")
    op.execute(f"CREATE TRIGGER {name} BEFORE {verb} ON {table} FOR EACH ROW EXECUTE FUNCTION {name}()")


def allow(name: str, table: str) -> None:
    """Take such a trigger away."""
    if op.get_bind().dialect.name == "sqlite":
        op.execute(f"DROP TRIGGER {name}")
        return
    op.execute(f"DROP TRIGGER {name} ON {table}")
    op.execute(f"DROP FUNCTION {name}()")


def fix_search_path() -> None:
    """Let each trigger's function look for tables in its own schema alone (PostgreSQL).

    The apply worker of logical replication has an empty search path; and a caller's temporary table would otherwise be
    taken for ours. A revision that makes triggers ends with this.
    """
    for schema, name in _functions():
        op.execute(f'ALTER FUNCTION "{schema}"."{name}"() SET search_path = "{schema}", pg_temp')


def refuse_truncate(table: str, message: str) -> None:
    """Have PostgreSQL refuse TRUNCATE on a table, which fires no row's trigger."""
    if op.get_bind().dialect.name == "sqlite":
        return
    name = f"{table}_no_truncate"
    op.execute(
        f"CREATE FUNCTION {name}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        f"RAISE EXCEPTION '{message}' USING ERRCODE = 'integrity_constraint_violation'; END $$"
    )
    op.execute(f"CREATE TRIGGER {name} BEFORE TRUNCATE ON {table} FOR EACH STATEMENT EXECUTE FUNCTION {name}()")


def make_always(tables: Sequence[str]) -> None:
    """Let every trigger of these tables fire always, in sessions that replicate, too (PostgreSQL)."""
    if op.get_bind().dialect.name == "sqlite":
        return
    for table, name in op.get_bind().execute(OUR_TRIGGERS, {"tables": list(tables)}).all():
        op.execute(f'ALTER TABLE "{table}" ENABLE ALWAYS TRIGGER "{name}"')


def _functions() -> list[tuple[str, str]]:
    if op.get_bind().dialect.name == "sqlite":
        return []
    return [(schema, name) for schema, name in op.get_bind().execute(sa.text(OUR_FUNCTIONS)).all()]
