"""Regions of a session: its polygons, its line between thorax and abdomen; and their motion beside each sample."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("regions", sa.Text, nullable=False, server_default="{}"))
    op.add_column("samples", sa.Column("named_mm", sa.LargeBinary))


def downgrade() -> None:
    op.drop_column("samples", "named_mm")
    op.drop_column("sessions", "regions")
