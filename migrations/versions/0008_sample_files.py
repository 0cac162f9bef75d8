"""Samples move from the database into files of their own, whose folder is told as the attribute `samples_dir`."""

import sqlalchemy as sa
from alembic import context, op

from migrations.refusals import allow, refuse
from service.storage.samples.legacy_rows import move_back, move_out

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

TRIGGERS = {
    "samples_no_update": ("samples", "UPDATE", None, "samples are append-only"),
    "samples_no_delete": ("samples", "DELETE", None, "samples are append-only"),
    "samples_only_next": (
        *("samples", "INSERT"),
        "NEW.frame_index <= (SELECT MAX(frame_index) FROM samples WHERE session_id = NEW.session_id)",
        "samples come in order",
    ),
}


def upgrade() -> None:
    move_out(op.get_bind(), context.config.attributes.get("samples_dir"))
    for name, (table, *_) in TRIGGERS.items():
        allow(name, table)
    op.drop_table("samples")


def downgrade() -> None:
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
        *(sa.Column(name, BIG, nullable=False) for name in ("received_ns", "decided_ns", "asserted_ns")),
        sa.Column("region_rows", sa.Integer),
        sa.Column("regions_mm", sa.LargeBinary),
        sa.Column("named_mm", sa.LargeBinary),
        sa.Column("captured_ns", BIG),
        sa.Column("phase_percent", sa.Double),
        sqlite_with_rowid=False,
    )
    move_back(op.get_bind(), context.config.attributes.get("samples_dir"))
    for name, trigger in TRIGGERS.items():
        refuse(name, *trigger)
