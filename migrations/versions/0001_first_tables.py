"""The first tables: calibrations, sessions, samples, models, audit, idempotency keys.

Samples and audit rows may be added and read, nothing else. The triggers on INSERT are needed beside those on UPDATE and
DELETE: `INSERT OR REPLACE` removes a row without firing a DELETE trigger.
"""

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, refuse

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

APPEND_ONLY = {"audit": "the audit log is append-only", "samples": "samples are append-only"}
# What an inserted row must not be, and what is said then; `new` is the row.
ONLY_NEXT = {
    "audit": (
        "NEW.sequence <> (SELECT COALESCE(MAX(sequence), 0) + 1 FROM audit)",
        "the audit log takes the next row only",
    ),
    "samples": (
        "NEW.frame_index <= (SELECT MAX(frame_index) FROM samples WHERE session_id = NEW.session_id)",
        "samples come in order",
    ),
}


def _triggers() -> dict[str, tuple[str, str, str | None, str]]:
    """Name each trigger: its table, its verb, when it refuses (None is always), and what it says."""
    made = {}
    for table, message in APPEND_ONLY.items():
        made[f"{table}_no_update"] = (table, "UPDATE", None, message)
        made[f"{table}_no_delete"] = (table, "DELETE", None, message)
    for table, (condition, message) in ONLY_NEXT.items():
        made[f"{table}_only_next"] = (table, "INSERT", condition, message)
    return made


def upgrade() -> None:
    _create_calibrations()
    _create_sessions()
    _create_samples()
    _create_models()
    _create_audit()
    for name, trigger in _triggers().items():
        refuse(name, *trigger)


def downgrade() -> None:
    for name, (table, *_) in _triggers().items():
        allow(name, table)
    for table in ("idempotency_keys", "audit", "models", "samples", "sessions", "calibrations"):
        op.drop_table(table)


def _create_calibrations() -> None:
    op.create_table(
        "calibrations",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("sha256", sa.String(64), nullable=False, unique=True),
        sa.Column("camera", sa.String(80), nullable=False),
        sa.Column("document", sa.Text, nullable=False),
        sa.Column("uploaded_by", sa.String(80), nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
    )


def _create_sessions() -> None:
    op.create_table(
        "sessions",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("status", sa.String(16), nullable=False),
        sa.Column("status_detail", sa.Text, nullable=False),
        sa.Column("patient_reference", sa.String(80), nullable=False),
        sa.Column("plan_id", sa.String(80), nullable=False),
        sa.Column("fraction_id", sa.String(80), nullable=False),
        sa.Column("fraction_number", sa.Integer),
        sa.Column("operator", sa.String(80), nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("window", sa.Text, nullable=False),
        sa.Column("calibration_id", sa.String(32), sa.ForeignKey("calibrations.id"), nullable=False),
        sa.Column("is_simulated_beam", sa.Boolean, nullable=False),
        sa.Column("summary", sa.Text),
        sa.Column("created_at", sa.String(27), nullable=False),
        sa.Column("started_at", sa.String(27)),
        sa.Column("ended_at", sa.String(27)),
    )
    op.create_index("ix_sessions_created", "sessions", ["created_at", "id"])


def _create_samples() -> None:
    op.create_table(
        "samples",
        sa.Column("session_id", sa.String(32), sa.ForeignKey("sessions.id"), primary_key=True),
        sa.Column("frame_index", sa.Integer, primary_key=True),
        sa.Column("timestamp_us", BIG, nullable=False),
        sa.Column("missed_frames", sa.Integer, nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("lost_reason", sa.String(32)),
        *(sa.Column(name, sa.Double) for name in ("whole_mm", "thorax_mm", "abdomen_mm", "volume_l")),
        *(sa.Column(name, sa.Double) for name in ("signal_mm", "residual_mm", "valid_share")),
        sa.Column("gate", sa.String(16), nullable=False),
        sa.Column("hold_reason", sa.String(32)),
        sa.Column("line_on", sa.Boolean, nullable=False),
        sa.Column("received_ns", BIG, nullable=False),
        sa.Column("decided_ns", BIG, nullable=False),
        sa.Column("asserted_ns", BIG, nullable=False),
        sa.Column("region_rows", sa.Integer),
        sa.Column("regions_mm", sa.LargeBinary),
        sqlite_with_rowid=False,
    )


def _create_models() -> None:
    op.create_table(
        "models",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("session_id", sa.String(32), sa.ForeignKey("sessions.id"), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("spectrum", sa.Text, nullable=False),
        sa.Column("components", sa.Integer, nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
        sa.UniqueConstraint("session_id", "number"),
    )


def _create_audit() -> None:
    op.create_table(
        "audit",
        sa.Column("sequence", BIG, primary_key=True, autoincrement=False),
        sa.Column("at", sa.String(27), nullable=False),
        sa.Column("actor", sa.String(80), nullable=False),
        sa.Column("action", sa.String(40), nullable=False),
        sa.Column("outcome", sa.String(16), nullable=False),
        sa.Column("session_id", sa.String(32)),
        sa.Column("detail", sa.Text, nullable=False),
        sa.Column("previous_hash", sa.String(64), nullable=False),
        sa.Column("hash", sa.String(64), nullable=False),
    )
    op.create_index("ix_audit_session", "audit", ["session_id", "action", "sequence"])
    op.create_table(
        "idempotency_keys",
        sa.Column("route", sa.String(80), primary_key=True),
        sa.Column("key", sa.String(255), primary_key=True),
        sa.Column("request_sha256", sa.String(64), nullable=False),
        sa.Column("answer", sa.Text, nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
    )
