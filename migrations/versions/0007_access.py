"""Who may do what: users, log-ins, API keys, and the failed attempts that lock them."""

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    pass


def downgrade() -> None:
    pass
