"""Stored models: what made each, and the one a session begins with."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("model_id", sa.String(32)))
    op.add_column("models", sa.Column("provenance", sa.Text, nullable=False, server_default="{}"))


def downgrade() -> None:
    op.drop_column("models", "provenance")
    op.drop_column("sessions", "model_id")
