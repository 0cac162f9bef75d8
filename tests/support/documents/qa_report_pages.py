"""Pictures of QA reports for people to look at: ``python -m tests.support.documents.qa_report_pages OUT [RUNS]``.

Monthly runs on the virtual set-up, each with another seed, through the very code of ``tidegate qa monthly``; the last
one with every frame 150 ms late. Not a test: what is wrong with a picture is for eyes.
"""

import contextlib
import subprocess
import sys
import tempfile
from pathlib import Path

from service.cli.qa.options import RunOptions
from service.cli.qa.run import do_run
from service.core.settings.database_place import DATABASE_NAME
from service.qa import queries, views
from service.qa.report.report import report_pdf
from service.storage.database.engine import Database

RUNS = 6
LATE_MS = 150.0
DPI = 110
OPERATOR = "A. Physicist"


def main(out: Path, runs: int = RUNS) -> None:
    """Do the runs and draw the newest two: a healthy one, and the late one."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        for seed in range(1, runs + 1):
            delay_ms = LATE_MS if seed == runs else 0.0
            options = RunOptions(
                kind="monthly", operator=OPERATOR, data=data, is_simulated=True, seed=seed, fault_delay_ms=delay_ms
            )
            do_run(options)
        out.mkdir(parents=True, exist_ok=True)
        with contextlib.closing(Database(data / DATABASE_NAME)) as database, database.read() as db:
            (late, healthy), _ = queries.run_page(db, None, 2)
            for name, row in (("qa-healthy", healthy), ("qa-late", late)):
                detail = views.run_detail(db, row, is_under_way=False)
                trends = [views.trend_answer(db, one.code, 30, before=row) for one in detail.results]
                (data / "report.pdf").write_bytes(report_pdf(detail, trends))
                subprocess.run(["pdftoppm", "-r", str(DPI), "-png", data / "report.pdf", out / name], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(word) for word in sys.argv[2:3]))
