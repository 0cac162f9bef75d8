"""``tidegate report``: the report of a session that is over, as PDF or HTML."""

from pathlib import Path
from typing import Annotated

import typer

from engine.core.errors import TidegateError
from engine.core.files import whole_file
from service.cli.data_folder import settings_of_database
from service.cli.terminal import refused, say
from service.core.errors import BoundError
from service.core.settings.settings import SettingsError
from service.sessions.report.pages import report_html, report_pdf
from service.sessions.report.reports import report_service
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database
from service.storage.database.startup import SAMPLES_FOLDER
from service.storage.samples.store import SampleStore

ACTOR, ACTION = "tidegate report", "report.export"
FORMS = (".pdf", ".html")


def report(
    session: Annotated[str, typer.Argument(help="The session's id.", metavar="SESSION")],
    out: Annotated[Path, typer.Option(help="File to write: .pdf or .html.")],
    data: Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")] = None,
) -> None:
    """Write the report of a session that is over, as PDF or HTML.

    The service may be running. The report states windows, reference, beam, motion while the beam was on, holds,
    latencies, who did what, versions and hashes. The same session gives the same bytes.
    """
    try:
        if out.suffix not in FORMS:
            msg = f"out must end in {' or '.join(FORMS)}"
            raise BoundError(msg, field="out", value=out.name, bound=" or ".join(FORMS))
        settings = settings_of_database(data)
        database = Database(settings.database_place)
        try:
            samples = SampleStore(settings.data_dir / SAMPLES_FOLDER)
            stored = report_service(database, samples, settings).of(session)
            body = report_pdf(stored) if out.suffix == ".pdf" else report_html(stored).encode()
            with whole_file(out) as file:
                file.write(body)
            detail = {"format": out.suffix[1:]}
            AuditLog(database).write(Event(actor=ACTOR, action=ACTION, session_id=session, detail=detail))
        finally:
            database.close()
    except (TidegateError, SettingsError) as error:
        raise refused("report", error) from error
    except OSError as error:
        raise refused("report", f"{error.filename or out} cannot be used ({error.strerror or error})") from error
    say(f"Written to {out}")
