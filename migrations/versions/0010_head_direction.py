"""The side of the picture at which the patient's head lies; unknown for the sessions before."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("head_direction", sa.String(8)))


def downgrade() -> None:
    op.drop_column("sessions", "head_direction")
