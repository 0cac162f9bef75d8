"""When the camera took each frame, on the host's clock, and where the breath stood."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.add_column("samples", sa.Column("captured_ns", BIG))
    op.add_column("samples", sa.Column("phase_percent", sa.Double))


def downgrade() -> None:
    op.drop_column("samples", "phase_percent")
    op.drop_column("samples", "captured_ns")
