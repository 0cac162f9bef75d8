"""The session that a session continues; none for the sessions before."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("continues", sa.String(32)))
    op.create_index("ix_sessions_continues", "sessions", ["continues"])


def downgrade() -> None:
    op.drop_index("ix_sessions_continues", "sessions")
    op.drop_column("sessions", "continues")
