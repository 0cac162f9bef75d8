"""What is kept of QA, from the shell: lists, trends, reports, the baseline. Reading goes beside a running service."""

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import select
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from engine.errors import TidegateError
from service.cli import qa_tables
from service.cli.terminal import refused, say
from service.cli.written import write_whole
from service.db.engine import Database
from service.db.models import QaRunRow
from service.db.preparing import prepare
from service.errors import BoundError, NotFoundError
from service.folder_lock import alone_in
from service.qa import records, views
from service.qa.book import TREND_RUNS, measured_by
from service.qa.report import report_pdf
from service.schema_base import Name
from service.settings import Settings, SettingsError, load_settings

NAME: TypeAdapter[str] = TypeAdapter(Name)


def print_runs(data: Path | None, limit: int) -> None:
    """List the newest runs."""
    with _reading("list", data) as (_, db):
        rows, _ = records.run_page(db, None, limit)
        qa_tables.print_runs([views.run_answer(db, row, is_under_way=True) for row in rows])


def print_trend(data: Path | None, check: str, limit: int) -> None:
    """Print a check over the newest runs."""
    with _reading("trend", data) as (_, db):
        qa_tables.print_trend(views.trend_answer(db, check, limit))


def print_checks(data: Path | None) -> None:
    """List what is checked."""
    try:
        qa_tables.print_checks(views.check_list(load_settings(data_dir=data)))
    except SettingsError as error:
        raise refused("qa checks", error) from error


def write_report(data: Path | None, run_id: str, out: Path) -> None:
    """Print a finished run."""
    with _reading("report", data) as (_, db):
        row = _run(db, run_id)
        run = views.run_detail(db, row, is_under_way=True)
        if run.status != "finished":
            raise BoundError(f"run {row.id} is {run.status}: only a finished one is printed", field="status")
        trends = [views.trend_answer(db, one.code, TREND_RUNS, before=row) for one in run.results]
    try:
        write_whole(out, report_pdf(run, trends))
    except OSError as error:
        raise refused("qa report", f"{out} cannot be written ({error.strerror or error})") from error
    say(f"Written to {out}")


def print_baseline(data: Path | None) -> None:
    """Print the baseline that holds, and those before it."""
    with _reading("baseline", data) as (_, db):
        qa_tables.print_baseline(views.baseline_history(records.baseline_rows(db)))


def fix_baseline(
    data: Path | None, given: Mapping[str, float], from_run: str | None, *, operator: str, reason: str
) -> None:
    """Fix a baseline; refused beside a running service, whose own way is the API."""
    try:
        for name, text in (("operator", operator), ("reason", reason)):
            _check_name(name, text)
        if given and from_run is not None:
            raise BoundError("give values or --from-run, not both", field="from_run")
        settings = load_settings(data_dir=data)
        with alone_in(settings.data_dir), closing(Database(settings.database_place)) as database:
            prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
            with database.write() as db:
                expected = given if from_run is None else measured_by(db, _run(db, from_run).id)
                row = records.fix_baseline(db, expected, operator=operator, reason=reason)
                say(f"Baseline no. {row.number} fixed by {operator}")
    except (SettingsError, TidegateError) as error:
        raise refused("qa baseline", error) from error
    print_baseline(data)


@contextmanager
def _reading(command: str, data: Path | None) -> Iterator[tuple[Settings, Session]]:
    """Open a data folder's database to read; nothing is made where there is none."""
    try:
        settings = load_settings(data_dir=data)
        place = settings.database_place
        if isinstance(place, Path) and not place.is_file():
            raise NotFoundError(f"there is no QA in {settings.data_dir}: no database", field="data")
        with closing(Database(place)) as database, database.read() as db:
            yield settings, db
    except OperationalError as error:
        text = "the database there is of an older version: start a service or do a QA with the folder once"
        raise refused(f"qa {command}", text) from error
    except (SettingsError, TidegateError) as error:
        raise refused(f"qa {command}", error) from error


def _run(db: Session, text: str) -> QaRunRow:
    """Find a run by its id or its first signs."""
    found = db.scalars(select(QaRunRow).where(QaRunRow.id.startswith(text, autoescape=True)).limit(2)).all()
    if len(found) != 1:
        said = "there is no such QA run" if not found else "more than one QA run begins so"
        raise NotFoundError(f"{said}: {text}", field="run_id", value=text)
    return found[0]


def _check_name(field: str, text: str) -> None:
    try:
        NAME.validate_python(text)
    except ValidationError as error:
        bound = "1 to 80 printable characters"
        raise BoundError(f"--{field} must be {bound}", field=field, value=text, bound=bound) from error
