"""The first reference that a session's fraction has had; none for the sessions before."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("first_reference", sa.Text()))


def downgrade() -> None:
    op.drop_column("sessions", "first_reference")
