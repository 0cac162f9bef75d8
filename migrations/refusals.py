"""Triggers that refuse a change, on both databases.

Used by revisions that are out in the world: what is here may be added to, and not be changed.
"""

from alembic import op


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
