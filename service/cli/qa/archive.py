"""Stored QA results: lists, trends, reports, the baseline. Reading is possible while a service runs.

``tidegate qa code``: make and display a one-time code for a QA run that is started over the API.
"""

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

import typer
from pydantic import TypeAdapter, ValidationError
from sqlalchemy import select
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from engine.core.errors import TidegateError
from engine.core.files import write_whole
from service.access.accounts.records import name_key
from service.access.accounts.store import AccessStore
from service.cli.access.account_services import BY
from service.cli.data_folder import settings_of_database, settings_of_folder
from service.cli.qa import tables
from service.cli.terminal import refused, say
from service.core.errors import BoundError, NotFoundError
from service.core.permissions import Permission, permissions_of
from service.core.schemas.base import Name
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.qa import queries, views
from service.qa.archive import TREND_RUNS, measured_by
from service.qa.latency.requirement import latency_list
from service.qa.one_time_code import VALID_S, OneTimeCodes
from service.qa.report.report import report_pdf
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from service.storage.database.tables import QaRunRow
from service.storage.files.folder_lock import alone_in

NAME: TypeAdapter[str] = TypeAdapter(Name)
ACTION = "qa.code"
COMMAND = "qa code"


def print_runs(data: Path | None, limit: int) -> None:
    """List the newest runs."""
    with _reading("list", data) as (_, db):
        rows, _ = queries.run_page(db, None, limit)
        tables.print_runs([views.run_answer(db, row, is_under_way=True) for row in rows])


def print_trend(data: Path | None, check: str, limit: int) -> None:
    """Print a check over the newest runs."""
    with _reading("trend", data) as (_, db):
        tables.print_trend(views.trend_answer(db, check, limit))


def print_checks(data: Path | None) -> None:
    """Print the table of checks."""
    try:
        settings = load_settings() if data is None else settings_of_folder(data)
        tables.print_checks(views.check_list(settings))
    except (SettingsError, NotFoundError) as error:
        raise refused("qa checks", error) from error


def write_report(data: Path | None, run_id: str, out: Path) -> None:
    """Write the report of a finished run."""
    with _reading("report", data) as (_, db):
        row = _run(db, run_id)
        run = views.run_detail(db, row, is_under_way=True)
        if run.status != "finished":
            raise BoundError(f"run {row.id} is {run.status}: a report needs a finished run", field="status")
        trends = [views.trend_answer(db, one.code, TREND_RUNS, before=row) for one in run.results]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, report_pdf(run, trends))
    except OSError as error:
        raise refused("qa report", f"{out} cannot be written ({error.strerror or error})") from error
    say(f"Written to {out}")


def print_cameras(data: Path | None) -> None:
    """Print the newest latency of each camera and mode."""
    with _reading("cameras", data) as (settings, db):
        tables.print_cameras(latency_list(db, settings))


def print_baseline(data: Path | None) -> None:
    """Print the current baseline and the earlier ones."""
    with _reading("baseline", data) as (_, db):
        tables.print_baseline(views.baseline_history(queries.baseline_rows(db)))


def fix_baseline(
    data: Path | None, given: Mapping[str, float], from_run: str | None, *, operator: str, reason: str
) -> None:
    """Set the baseline; refused while a service uses the folder: use its API."""
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
                row = queries.fix_baseline(db, expected, operator=operator, reason=reason)
                say(f"Baseline no. {row.number} set by {operator}")
    except (SettingsError, TidegateError) as error:
        raise refused("qa baseline", error) from error
    print_baseline(data)


@contextmanager
def _reading(command: str, data: Path | None) -> Iterator[tuple[Settings, Session]]:
    """Open the database of a data folder for reading; a failure ends the command with one line."""
    try:
        settings = settings_of_database(data)
        with closing(Database(settings.database_place)) as database, database.read() as db:
            yield settings, db
    except OperationalError as error:
        text = "the database has an older schema: run `tidegate database upgrade`"
        raise refused(f"qa {command}", text) from error
    except (SettingsError, TidegateError) as error:
        raise refused(f"qa {command}", error) from error


def _run(db: Session, text: str) -> QaRunRow:
    """Return the run whose id is or begins with ``text``; raise NotFoundError."""
    found = db.scalars(select(QaRunRow).where(QaRunRow.id.startswith(text, autoescape=True)).limit(2)).all()
    if len(found) != 1:
        said = "there is no such QA run" if not found else "more than one QA run id begins with this"
        raise NotFoundError(f"{said}: {text}", field="run_id", value=text)
    return found[0]


def _check_name(field: str, text: str) -> None:
    try:
        NAME.validate_python(text)
    except ValidationError as error:
        bound = "1 to 80 printable characters"
        raise BoundError(f"--{field} must be {bound}", field=field, value=text, bound=bound) from error


def show_code(data: Path | None, operator: str) -> None:
    """Audit, make and print a code for a person who may start QA; nothing is made if that cannot be audited."""
    try:
        settings = settings_of_database(data)
        with closing(Database(settings.database_place)) as database:
            name = _physicist(database, operator)
            AuditLog(database).write(Event(actor=BY, action=ACTION, detail={"operator": name, "valid_s": VALID_S}))
        text = OneTimeCodes(settings.data_dir).make(name)
    except OperationalError as error:
        text = "the database does not answer, or has an older schema: run `tidegate database upgrade`"
        raise refused(COMMAND, text) from error
    except OSError as error:
        raise refused(COMMAND, f"{settings.data_dir} cannot be written ({error.strerror or error})") from error
    except (SettingsError, TidegateError) as error:
        raise refused(COMMAND, error) from error
    typer.echo(f"{text}  for {name}, for {VALID_S / 60.0:g} minutes and one run. Its drills permit the real beam line.")


def _physicist(database: Database, operator: str) -> str:
    """Return the account's name; raise NotFoundError or BoundError if this person may not start QA."""
    store = AccessStore(database)
    store.load()
    user = store.users.get(name_key(operator))
    if user is None:
        msg = f"there is no account {operator!r}"
        raise NotFoundError(msg, field="operator", value=operator)
    if user.is_disabled or Permission.QA_RUN not in permissions_of(user.roles):
        bound = "an enabled account with the role physicist"
        msg = f"{user.name} may not start QA runs: --operator must be {bound}"
        raise BoundError(msg, field="operator", value=user.name, bound=bound)
    return user.name
