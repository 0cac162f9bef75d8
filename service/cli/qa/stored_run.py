"""A QA run on the command line, from its record in the data folder to its report: the same as the service's."""

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from engine.core.errors import TidegateError
from engine.core.files import write_whole
from engine.qa import QaBaseline, QaNeed
from service.cli.qa.tables import print_results
from service.cli.terminal import frame_bar, refused, say
from service.core.errors import BoundError
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.beam_lines import alone_at_targets
from service.qa import queries, schemas, views
from service.qa.archive import TREND_RUNS, close_interrupted
from service.qa.jobs import Handle, QaJob, run_job
from service.qa.report.report import report_pdf
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from service.storage.files.folder_lock import alone_in
from service.web.problems.table import problem_of

STAGES = {
    QaNeed.PLATE: "plate, frames",
    QaNeed.PHANTOM: "phantom, frames",
    QaNeed.BEAM: "beam line, drills",
    QaNeed.CAMERA: "camera, frames",
}
Request = TypeVar("Request", bound=BaseModel)


# Signals during a run that permits a beam.
@contextmanager
def interruptible() -> Iterator[None]:
    """Handle SIGTERM and SIGINT as Ctrl-C: the line is held and the run recorded before the process ends.

    SIGINT explicitly too: a shell starts background processes with it ignored, and this process permits a beam.
    """

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(frozen=True, slots=True, kw_only=True)
class BegunRun:
    """A run that is recorded as begun, and the baseline that it is compared with."""

    run_id: str
    job: QaJob
    baseline: QaBaseline


Begin = Callable[[Settings, Database], BegunRun]


def carry_out(command: str, begin: Begin, *, data: Path | None, out: Path | None) -> str:
    """Carry out a run, print its results and write its report.

    Parameters
    ----------
    command
        The subcommand, for messages.
    begin
        Checks the options, records the run, and returns it; raises a TidegateError naming what cannot be used.
    data, out
        The data folder, and the file of the report; None for the setting's, and for no report.

    Returns
    -------
    str
        The verdict; ``fail`` if the run was not completed.
    """
    try:
        settings = load_settings(data_dir=data)
        alone = alone_in(settings.data_dir)
        with alone, alone_at_targets(settings), closing(Database(settings.database_place)) as database:
            prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
            close_interrupted(database)  # the folder's lock is held, so no other process has a run
            begun = begin(settings, database)
            _follow(begun, settings, database)
            run = _reported(begun.run_id, database, out)
    except (SettingsError, TidegateError) as error:
        raise refused(command, error) from error
    except OSError as error:
        raise refused(command, f"{out} cannot be written ({error.strerror or error})") from error
    if run.status != "finished":
        say(f"tidegate {command}: {run.status}: {run.status_detail}", "red")
        return "fail"
    print_results(run)
    return run.verdict or "fail"


def checked(model: type[Request], fields: Mapping[str, Any]) -> Request:
    """Build a request of the API, so that the same bounds apply; raise BoundError naming the field and its bound."""
    try:
        return model.model_validate(fields)
    except ValidationError as error:
        details = [{**one, "loc": ("body", *one["loc"])} for one in error.errors()]
        problem = problem_of(RequestValidationError(details))
        raise BoundError(problem.detail, field=problem.field, bound=problem.bound) from error


def _follow(begun: BegunRun, settings: Settings, database: Database) -> None:
    """Run the job with a progress bar, and record its outcome."""

    def end(outcome: queries.QaOutcome) -> None:
        with database.write() as db:
            queries.end(db, begun.run_id, outcome)

    with interruptible(), frame_bar() as bar:
        tasks: dict[QaNeed, Any] = {}

        def show(stage: QaNeed, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(STAGES[stage], total=total)
            bar.update(tasks[stage], completed=done, total=total)

        handle = Handle(begun.job.line)
        run_job(begun.job, handle, bounds=settings.qa_bounds, baseline=begun.baseline, on_end=end, also=show)


def _reported(run_id: str, database: Database, out: Path | None) -> schemas.QaRunDetail:
    """Read the run from the database, and write its report if one is requested."""
    with database.read() as db:
        row = queries.run_row(db, run_id)
        run = views.run_detail(db, row, is_under_way=False)
        if out is not None and run.status == "finished":
            trends = [views.trend_answer(db, one.code, TREND_RUNS, before=row) for one in run.results]
            out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(out, report_pdf(run, trends))
            say(f"Written to {out}")
    return run
