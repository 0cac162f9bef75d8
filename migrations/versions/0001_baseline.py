"""The tables of Tidegate 1.0.0.

Audit, calibrations, models, plans and QA's tables may be added to and read, nothing else, by every way round the
triggers there is:

* SQLite: `INSERT OR REPLACE` removes a row without firing a DELETE trigger. The triggers on INSERT look for a row of
  the same key, and of the same hidden `rowid`.
* PostgreSQL: TRUNCATE fires no row's trigger, and `session_replication_role = replica` leaves ordinary triggers out: so
  there is a trigger on TRUNCATE, and all of them fire always.
"""

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, fix_search_path, make_always, refuse, refuse_truncate

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
AT = sa.String(27)
ID = sa.String(32)
NAME = sa.String(80)
SHA256 = sa.String(64)

NEW_ONLY = {
    "calibrations": "id = NEW.id OR sha256 = NEW.sha256",
    "models": "id = NEW.id OR (session_id = NEW.session_id AND number = NEW.number)",
    "plans": "id = NEW.id OR sha256 = NEW.sha256 OR sop_instance_uid = NEW.sop_instance_uid",
    "plan_contradictions": "id = NEW.id",
    "qa_runs": "id = NEW.id",
    "qa_outcomes": "run_id = NEW.run_id",
    "qa_results": "run_id = NEW.run_id AND code = NEW.code",
}
"""Tables of which a row is never replaced, and what makes a row the same one; their `rowid` in SQLite is hidden."""
NEXT_ONLY = {
    "audit": ("sequence", "the audit log takes the next row only"),
    "qa_baselines": ("number", "the QA baselines take the next row only"),
}
"""Tables whose rows are numbered without a gap: the column of the number, and what is said of another one."""
SEALED = (*NEW_ONLY, *NEXT_ONLY)
TABLES = (
    *("calibrations", "sessions", "models", "audit", "idempotency_keys", "qa_baselines", "qa_runs", "qa_outcomes"),
    *("qa_results", "users", "logins", "api_keys", "failed_logins", "plans", "plan_contradictions"),
)
"""In an order in which each can be made; dropped in the other."""


def upgrade() -> None:
    _create_sessions()
    _create_records()
    _create_qa()
    _create_access()
    _create_plans()
    for name, trigger in _triggers().items():
        refuse(name, *trigger)
    for table in SEALED:
        refuse_truncate(table, _words(table))
    make_always(SEALED)
    fix_search_path()


def downgrade() -> None:
    for name, (table, *_) in _triggers().items():
        allow(name, table)
    if op.get_bind().dialect.name == "postgresql":
        for table in SEALED:
            allow(f"{table}_no_truncate", table)
    for table in reversed(TABLES):
        op.drop_table(table)


def _words(table: str) -> str:
    return "the audit log is append-only" if table == "audit" else f"{table} is append-only"


def _triggers() -> dict[str, tuple[str, str, str | None, str]]:
    """Name each trigger: its table, its verb, when it refuses (None is always), and what it says."""
    made: dict[str, tuple[str, str, str | None, str]] = {}
    for table in SEALED:
        for verb in ("UPDATE", "DELETE"):
            made[f"{table}_no_{verb.lower()}"] = (table, verb, None, _words(table))
    for table, (column, words) in NEXT_ONLY.items():
        is_other = f"NEW.{column} <> (SELECT COALESCE(MAX({column}), 0) + 1 FROM {table})"  # noqa: S608 # nosec B608
        made[f"{table}_only_next"] = (table, "INSERT", is_other, words)
    for table, same in NEW_ONLY.items():
        known = {f"{table}_only_new": same}
        if op.get_bind().dialect.name == "sqlite":
            known[f"{table}_only_new_rowid"] = "rowid = NEW.rowid"
        for name, condition in known.items():
            is_there = f"EXISTS (SELECT 1 FROM {table} WHERE {condition})"  # noqa: S608 # nosec B608
            made[name] = (table, "INSERT", is_there, _words(table))
    # A result belongs to a run that is under way: none is added to a run that has ended.
    has_ended = "EXISTS (SELECT 1 FROM qa_outcomes WHERE run_id = NEW.run_id)"
    made["qa_results_no_late"] = ("qa_results", "INSERT", has_ended, "the QA run has ended")
    return made


def _create_sessions() -> None:
    op.create_table(
        "calibrations",
        sa.Column("id", ID, primary_key=True),
        sa.Column("sha256", SHA256, nullable=False, unique=True),
        sa.Column("camera", NAME, nullable=False),
        sa.Column("document", sa.Text, nullable=False),
        sa.Column("uploaded_by", NAME, nullable=False),
        sa.Column("created_at", AT, nullable=False),
    )
    op.create_table(
        "sessions",
        sa.Column("id", ID, primary_key=True),
        sa.Column("status", sa.String(16), nullable=False),
        sa.Column("status_detail", sa.Text, nullable=False),
        sa.Column("patient_reference", NAME, nullable=False),
        sa.Column("plan_id", NAME, nullable=False),
        sa.Column("fraction_id", NAME, nullable=False),
        sa.Column("fraction_number", sa.Integer),
        sa.Column("operator", NAME, nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("window", sa.Text, nullable=False),
        sa.Column("calibration_id", ID, sa.ForeignKey("calibrations.id"), nullable=False),
        sa.Column("is_simulated_beam", sa.Boolean, nullable=False),
        sa.Column("summary", sa.Text),
        sa.Column("created_at", AT, nullable=False),
        sa.Column("started_at", AT),
        sa.Column("ended_at", AT),
        sa.Column("regions", sa.Text, nullable=False, server_default="{}"),
        sa.Column("model_id", ID),
        sa.Column("rt_plan_id", ID),
        sa.Column("head_direction", sa.String(8)),
        sa.Column("first_reference", sa.Text),
        sa.Column("continues", ID),
    )
    op.create_index("ix_sessions_created", "sessions", ["created_at", "id"])
    op.create_index("ix_sessions_rt_plan_id", "sessions", ["rt_plan_id"])
    op.create_index("ix_sessions_continues", "sessions", ["continues"])
    op.create_table(
        "models",
        sa.Column("id", ID, primary_key=True),
        sa.Column("session_id", ID, sa.ForeignKey("sessions.id"), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("sha256", SHA256, nullable=False),
        sa.Column("spectrum", sa.Text, nullable=False),
        sa.Column("components", sa.Integer, nullable=False),
        sa.Column("created_at", AT, nullable=False),
        sa.Column("provenance", sa.Text, nullable=False, server_default="{}"),
        sa.UniqueConstraint("session_id", "number"),
    )


def _create_records() -> None:
    op.create_table(
        "audit",
        sa.Column("sequence", BIG, primary_key=True, autoincrement=False),
        sa.Column("at", AT, nullable=False),
        sa.Column("actor", NAME, nullable=False),
        sa.Column("action", sa.String(40), nullable=False),
        sa.Column("outcome", sa.String(16), nullable=False),
        sa.Column("session_id", ID),
        sa.Column("detail", sa.Text, nullable=False),
        sa.Column("previous_hash", SHA256, nullable=False),
        sa.Column("hash", SHA256, nullable=False),
    )
    op.create_index("ix_audit_session", "audit", ["session_id", "action", "sequence"])
    op.create_table(
        "idempotency_keys",
        sa.Column("route", NAME, primary_key=True),
        sa.Column("key", sa.String(255), primary_key=True),
        sa.Column("request_sha256", SHA256, nullable=False),
        sa.Column("answer", sa.Text, nullable=False),
        sa.Column("created_at", AT, nullable=False),
    )


def _create_qa() -> None:
    op.create_table(
        "qa_baselines",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("expected", sa.Text, nullable=False),
        sa.Column("set_by", NAME, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("created_at", AT, nullable=False),
    )
    op.create_table(
        "qa_runs",
        sa.Column("id", ID, primary_key=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("operator", NAME, nullable=False),
        sa.Column("site", NAME, nullable=False),
        sa.Column("machine", NAME, nullable=False),
        sa.Column("request", sa.Text, nullable=False),
        sa.Column("is_simulated", sa.Boolean, nullable=False),
        sa.Column("is_simulated_beam", sa.Boolean, nullable=False),
        sa.Column("plate_sha256", SHA256),
        sa.Column("bounds", sa.Text, nullable=False),
        sa.Column("baseline_number", sa.Integer, sa.ForeignKey("qa_baselines.number")),
        sa.Column("software", sa.String(40), nullable=False),
        sa.Column("created_at", AT, nullable=False),
    )
    op.create_index("ix_qa_runs_created", "qa_runs", ["created_at", "id"])
    op.create_index("ix_qa_runs_plate_sha256", "qa_runs", ["plate_sha256"])
    op.create_table(
        "qa_outcomes",
        sa.Column("run_id", ID, sa.ForeignKey("qa_runs.id"), primary_key=True),
        sa.Column("status", sa.String(16), nullable=False),
        sa.Column("status_detail", sa.Text, nullable=False),
        sa.Column("verdict", sa.String(8)),
        sa.Column("series", sa.Text, nullable=False),
        sa.Column("sha256", SHA256, nullable=False),
        sa.Column("ended_at", AT, nullable=False),
    )
    op.create_table(
        "qa_results",
        sa.Column("run_id", ID, sa.ForeignKey("qa_runs.id"), primary_key=True),
        sa.Column("code", sa.String(48), primary_key=True),
        sa.Column("position", sa.Integer, nullable=False),
        sa.Column("value", sa.Double),
        sa.Column("unit", sa.String(16), nullable=False),
        sa.Column("expected", sa.Double),
        sa.Column("deviation", sa.Double),
        sa.Column("uncertainty", sa.Double),
        sa.Column("warn", sa.Double, nullable=False),
        sa.Column("fail", sa.Double, nullable=False),
        sa.Column("verdict", sa.String(8), nullable=False),
        sa.Column("detail", sa.Text, nullable=False),
    )
    op.create_index("ix_qa_results_code", "qa_results", ["code", "run_id"])


def _create_access() -> None:
    op.create_table(
        "users",
        sa.Column("key", sa.String(320), primary_key=True),
        sa.Column("name", NAME, nullable=False),
        sa.Column("password_hash", sa.String(200)),
        sa.Column("roles", NAME, nullable=False),
        sa.Column("is_disabled", sa.Boolean, nullable=False),
        sa.Column("must_change_password", sa.Boolean, nullable=False),
        sa.Column("is_break_glass", sa.Boolean, nullable=False),
        sa.Column("issuer", sa.String(255)),
        sa.Column("subject", sa.String(255)),
        sa.Column("created_at", AT, nullable=False),
        sa.Column("last_login_at", AT),
        sa.UniqueConstraint("issuer", "subject"),
    )
    op.create_table(
        "logins",
        sa.Column("token_sha256", SHA256, primary_key=True),
        sa.Column("id", ID, nullable=False, unique=True),
        sa.Column("user_key", sa.String(320), sa.ForeignKey("users.key"), nullable=False),
        sa.Column("way", sa.String(16), nullable=False),
        sa.Column("address", sa.String(64), nullable=False),
        sa.Column("is_break_glass", sa.Boolean, nullable=False),
        sa.Column("created_at", AT, nullable=False),
        sa.Column("expires_at", AT, nullable=False),
        sa.Column("seen_at", AT, nullable=False),
    )
    op.create_table(
        "api_keys",
        sa.Column("id", sa.String(16), primary_key=True),
        sa.Column("name", NAME, nullable=False),
        sa.Column("secret_sha256", SHA256, nullable=False),
        sa.Column("scopes", sa.Text, nullable=False),
        sa.Column("created_by", NAME, nullable=False),
        sa.Column("created_at", AT, nullable=False),
        sa.Column("expires_at", AT, nullable=False),
        sa.Column("revoked_at", AT),
        sa.Column("last_used_at", AT),
    )
    op.create_table(
        "failed_logins",
        sa.Column("subject", sa.String(330), primary_key=True),
        sa.Column("failures", sa.Integer, nullable=False),
        sa.Column("last_at", AT, nullable=False),
        sa.Column("locked_until", AT),
    )


def _create_plans() -> None:
    op.create_table(
        "plans",
        sa.Column("id", ID, primary_key=True),
        sa.Column("sop_instance_uid", sa.String(64), nullable=False, unique=True),
        sa.Column("sha256", SHA256, nullable=False, unique=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("label", sa.String(16), nullable=False),
        sa.Column("patient_reference", NAME, nullable=False),
        sa.Column("gating", sa.String(16), nullable=False),
        sa.Column("document", sa.Text, nullable=False),
        sa.Column("imported_by", NAME, nullable=False),
        sa.Column("created_at", AT, nullable=False),
    )
    op.create_index("ix_plans_created", "plans", ["created_at", "id"])
    op.create_index("ix_plans_patient_reference", "plans", ["patient_reference"])
    op.create_table(
        "plan_contradictions",
        sa.Column("id", ID, primary_key=True),
        sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), nullable=False),
        sa.Column("sha256", SHA256, nullable=False),
        sa.Column("approval", sa.String(16)),
        sa.Column("differing", sa.Text, nullable=False),
        sa.Column("imported_by", NAME, nullable=False),
        sa.Column("created_at", AT, nullable=False),
        sa.UniqueConstraint("plan_id", "sha256"),
    )
