"""RT Plans as they were read, added to and never changed; and which plan a session was prepared from."""

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, refuse

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

CONTRADICTIONS = "plan_contradictions"
SAME = "id = NEW.id OR sha256 = NEW.sha256 OR sop_instance_uid = NEW.sop_instance_uid"


def upgrade() -> None:
    op.create_table(
        "plans",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("sop_instance_uid", sa.String(64), nullable=False, unique=True),
        sa.Column("sha256", sa.String(64), nullable=False, unique=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("label", sa.String(16), nullable=False),
        sa.Column("patient_reference", sa.String(80), nullable=False),
        sa.Column("gating", sa.String(16), nullable=False),
        sa.Column("document", sa.Text, nullable=False),
        sa.Column("imported_by", sa.String(80), nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
    )
    op.create_index("ix_plans_created", "plans", ["created_at", "id"])
    op.create_index("ix_plans_patient_reference", "plans", ["patient_reference"])
    op.create_table(
        CONTRADICTIONS,
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("plan_id", sa.String(32), sa.ForeignKey("plans.id"), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("approval", sa.String(16)),
        sa.Column("differing", sa.Text, nullable=False),
        sa.Column("imported_by", sa.String(80), nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
        sa.UniqueConstraint("plan_id", "sha256"),
    )
    for name, trigger in _triggers().items():
        refuse(name, *trigger)
    if op.get_bind().dialect.name == "postgresql":
        _refuse_truncate()
    op.add_column("sessions", sa.Column("rt_plan_id", sa.String(32)))
    op.create_index("ix_sessions_rt_plan_id", "sessions", ["rt_plan_id"])


def downgrade() -> None:
    op.drop_index("ix_sessions_rt_plan_id", "sessions")
    op.drop_column("sessions", "rt_plan_id")
    if op.get_bind().dialect.name == "postgresql":
        for table in ("plans", CONTRADICTIONS):
            allow(f"{table}_no_truncate", table)
    for name, (table, *_) in _triggers().items():
        allow(name, table)
    op.drop_table(CONTRADICTIONS)
    op.drop_table("plans")


def _triggers() -> dict[str, tuple[str, str, str | None, str]]:
    """Name each trigger: its table, its verb, when it refuses (None is always), and what it says. See 0006."""
    made: dict[str, tuple[str, str, str | None, str]] = {}
    for table, same in (("plans", SAME), (CONTRADICTIONS, "id = NEW.id")):
        words = f"{table} is append-only"
        made |= {f"{table}_no_{verb.lower()}": (table, verb, None, words) for verb in ("UPDATE", "DELETE")}
        known = {f"{table}_only_new": same}
        if op.get_bind().dialect.name == "sqlite":
            known[f"{table}_only_new_rowid"] = "rowid = NEW.rowid"
        for name, condition in known.items():
            there = f"EXISTS (SELECT 1 FROM {table} WHERE {condition})"  # noqa: S608 - this file's own words # nosec B608
            made[name] = (table, "INSERT", there, words)
    return made


def _refuse_truncate() -> None:
    """Refuse what fires no row's trigger, and let all triggers fire for whoever replicates, too."""
    for table in ("plans", CONTRADICTIONS):
        name = f"{table}_no_truncate"
        op.execute(
            f"CREATE FUNCTION {name}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
            f"RAISE EXCEPTION '{table} is append-only' USING ERRCODE = 'integrity_constraint_violation'; END $$"
        )
        op.execute(f"CREATE TRIGGER {name} BEFORE TRUNCATE ON {table} FOR EACH STATEMENT EXECUTE FUNCTION {name}()")
        op.execute(f'ALTER TABLE {table} ENABLE ALWAYS TRIGGER "{name}"')
    for name, (table, *_) in _triggers().items():
        op.execute(f'ALTER TABLE {table} ENABLE ALWAYS TRIGGER "{name}"')
