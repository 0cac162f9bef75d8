"""QA: runs as asked for, how they ended, their judged checks, and the site's baselines.

All four may be added to and read, nothing else; see 0001 about the triggers on INSERT.
"""

import sqlalchemy as sa
from alembic import op

from migrations.refusals import allow, refuse

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

KEYS = {
    "qa_runs": "id = NEW.id",
    "qa_outcomes": "run_id = NEW.run_id",
    "qa_results": "run_id = NEW.run_id AND code = NEW.code",
}
NEXT_BASELINE = "NEW.number <> (SELECT COALESCE(MAX(number), 0) + 1 FROM qa_baselines)"
# A result belongs to a run that is under way: none is added to a run that has ended.
ENDED_RUN = "EXISTS (SELECT 1 FROM qa_outcomes WHERE run_id = NEW.run_id)"


def _triggers() -> dict[str, tuple[str, str, str | None, str]]:
    """Name each trigger: its table, its verb, when it refuses (None is always), and what it says."""
    made: dict[str, tuple[str, str, str | None, str]] = {
        "qa_baselines_only_next": (
            "qa_baselines",
            "INSERT",
            NEXT_BASELINE,
            "the QA baselines take the next row only",
        ),
        "qa_results_no_late": ("qa_results", "INSERT", ENDED_RUN, "the QA run has ended"),
    }
    for table in (*KEYS, "qa_baselines"):
        for verb in ("UPDATE", "DELETE"):
            made[f"{table}_no_{verb.lower()}"] = (table, verb, None, f"{table} is append-only")
    for table, same in KEYS.items():
        there = f"EXISTS (SELECT 1 FROM {table} WHERE {same})"  # noqa: S608 - names of this file alone # nosec B608
        made[f"{table}_only_new"] = (table, "INSERT", there, f"{table} is append-only")
    return made


def upgrade() -> None:
    _create_baselines()
    _create_runs()
    _create_outcomes()
    _create_results()
    for name, trigger in _triggers().items():
        refuse(name, *trigger)


def downgrade() -> None:
    for name, (table, *_) in _triggers().items():
        allow(name, table)
    for table in ("qa_results", "qa_outcomes", "qa_runs", "qa_baselines"):
        op.drop_table(table)


def _create_baselines() -> None:
    op.create_table(
        "qa_baselines",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("expected", sa.Text, nullable=False),
        sa.Column("set_by", sa.String(80), nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
    )


def _create_runs() -> None:
    op.create_table(
        "qa_runs",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("operator", sa.String(80), nullable=False),
        sa.Column("site", sa.String(80), nullable=False),
        sa.Column("machine", sa.String(80), nullable=False),
        sa.Column("request", sa.Text, nullable=False),
        sa.Column("is_simulated", sa.Boolean, nullable=False),
        sa.Column("is_simulated_beam", sa.Boolean, nullable=False),
        sa.Column("plate_sha256", sa.String(64)),
        sa.Column("bounds", sa.Text, nullable=False),
        sa.Column("baseline_number", sa.Integer, sa.ForeignKey("qa_baselines.number")),
        sa.Column("software", sa.String(40), nullable=False),
        sa.Column("created_at", sa.String(27), nullable=False),
    )
    op.create_index("ix_qa_runs_created", "qa_runs", ["created_at", "id"])
    op.create_index("ix_qa_runs_plate_sha256", "qa_runs", ["plate_sha256"])


def _create_outcomes() -> None:
    op.create_table(
        "qa_outcomes",
        sa.Column("run_id", sa.String(32), sa.ForeignKey("qa_runs.id"), primary_key=True),
        sa.Column("status", sa.String(16), nullable=False),
        sa.Column("status_detail", sa.Text, nullable=False),
        sa.Column("verdict", sa.String(8)),
        sa.Column("series", sa.Text, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("ended_at", sa.String(27), nullable=False),
    )


def _create_results() -> None:
    op.create_table(
        "qa_results",
        sa.Column("run_id", sa.String(32), sa.ForeignKey("qa_runs.id"), primary_key=True),
        sa.Column("code", sa.String(48), primary_key=True),
        sa.Column("position", sa.Integer, nullable=False),
        sa.Column("value", sa.Double),
        sa.Column("unit", sa.String(16), nullable=False),
        sa.Column("expected", sa.Double),
        sa.Column("deviation", sa.Double),
        sa.Column("uncertainty", sa.Double),
        sa.Column("warn", sa.Double, nullable=False),
        sa.Column("fail", sa.Double, nullable=False),
        sa.Column("verdict", sa.String(8), nullable=False),
        sa.Column("detail", sa.Text, nullable=False),
    )
    op.create_index("ix_qa_results_code", "qa_results", ["code", "run_id"])
