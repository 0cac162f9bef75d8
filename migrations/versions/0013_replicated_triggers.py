"""Triggers work where logical replication applies rows, and look at our tables only (PostgreSQL; docs/adr/0045)."""

from migrations.refusals import fix_search_path, free_search_path

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    fix_search_path()


def downgrade() -> None:
    free_search_path()
