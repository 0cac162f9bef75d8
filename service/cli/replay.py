"""``tidegate replay``: run a stored session again from the recorded inputs of its engine."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from engine.core.errors import TidegateError
from engine.offline.replay import MOTION_MM
from service.cli.data_folder import settings_of_database, settings_of_folder
from service.cli.terminal import advance, frame_bar, refused, say
from service.core.errors import NotFoundError
from service.core.settings.database_place import DATABASE_NAME
from service.core.settings.settings import SettingsError
from service.sessions.recovery.replay import StoredSession, Verdict
from service.storage.audit import Event
from service.storage.database.engine import Database
from service.storage.database.migrations import MigrationError, schema_status

DIFFERENT = 1
ACTION = "session.replayed"
ACTOR = "tidegate replay"


def replay(
    session: Annotated[str, typer.Argument(help="The session's id.", metavar="SESSION")],
    data: Annotated[
        Path | None,
        typer.Option(
            help="Data folder to read, e.g. a copy or a restored backup; its audit log is not written. By default the "
            "service's own folder, whose audit log records the replay."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for motion.csv and transitions.csv.")] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Path of the recording, if it was moved since the session.")
    ] = None,
    *,
    any_version: Annotated[
        bool, typer.Option("--any-version", help="Replay a session of another version of the software.")
    ] = False,
) -> None:
    """Replay a stored session and compare every gate decision and sample with the original.

    On a processor with the same features and with the same library versions the results must be equal to the last bit.
    Elsewhere the gate decisions must be equal and motion must agree within 0.001 mm; the output states which comparison
    was made.

    Exit code 0 when everything agrees, 1 when something differs, 2 when the session cannot be replayed.
    """
    try:
        database, data_dir, is_own = _opened(data)
        try:
            _refuse_older_schema(database)
            stored = StoredSession(database, data_dir, session)
            if not any_version:
                stored.refuse_other_version()
            verdict = _run(stored, recording)
            _print_verdict(verdict)
            if out is not None:
                _write(verdict, out)
            if is_own:
                _audit(database, session, verdict)
        finally:
            database.close()
    except (TidegateError, SettingsError) as error:
        raise refused("replay", error) from error
    except OSError as error:
        raise refused("replay", f"{error.filename or data} cannot be used ({error.strerror or error})") from error
    if not verdict.agrees:
        raise typer.Exit(DIFFERENT)


def _opened(data: Path | None) -> tuple[Database, Path, bool]:
    """Open the database of a copy in ``data``, else the service's own; the last value is whether it is the latter."""
    if data is None:
        settings = settings_of_database(None)
        return Database(settings.database_place), settings.data_dir, True
    settings_of_folder(data)
    if not (data / DATABASE_NAME).is_file():
        msg = f"there is no database in the data folder {data}"
        raise NotFoundError(msg, field="data")
    return Database(data / DATABASE_NAME), data, False


def _refuse_older_schema(database: Database) -> None:
    with database.connect() as connection:
        status = schema_status(connection)
    if status.ahead:
        found = f"the database is at revision {status.revision}, and {status.head} is needed"
        raise MigrationError(f"{found}: run `tidegate database upgrade`")


def _run(stored: StoredSession, recording: Path | None) -> Verdict:
    with frame_bar() as bar:
        shown = bar.add_task("replaying", total=stored.survey.frames)
        return stored.run_again(recording, lambda frames: advance(bar, shown, frames))


def _print_verdict(verdict: Verdict) -> None:
    for note in verdict.notes:
        say(f"Note: {note}", "yellow")
    replayed, comparison = verdict.replay, verdict.comparison
    if not comparison.is_exact:
        say(
            f"Note: motion is compared within {MOTION_MM} mm, not to the last bit; gate decisions must be equal",
            "yellow",
        )
    counted = (
        f"{replayed.frames} frames, {len(replayed.transitions) + len(replayed.elsewhere)} transitions "
        f"({verdict.audited} in the audit), {verdict.samples} samples"
    )
    if verdict.agrees and comparison.is_exact:
        typer.echo(f"identical: {counted}")
        return
    if verdict.agrees:
        typer.echo(f"agrees within {MOTION_MM} mm, gate decisions are equal: {counted}")
        typer.echo(f"  identical to the last bit: {replayed.identical_frames} of {replayed.frames} frames")
        return
    for difference in verdict.differences:
        place = "before the first frame" if difference.frame is None else f"at frame {difference.frame}"
        if comparison.is_exact:
            typer.echo(f"DIFFERENT {place}, after {replayed.frames} identical frames")
        else:
            what = f"numbers differ by more than {MOTION_MM} mm" if difference.is_of_numbers else "different decision"
            typer.echo(f"DIFFERENT {place}, after {replayed.frames} frames that agree within {MOTION_MM} mm: {what}")
        typer.echo(f"  recorded: {difference.recorded}")
        typer.echo(f"  replayed: {difference.replayed}")


def _audit(database: Database, session: str, verdict: Verdict) -> None:
    from service.storage import audit

    detail: dict[str, object] = {
        "is_identical": verdict.is_identical,
        "within_mm": 0.0 if verdict.comparison.is_exact else MOTION_MM,
        "frames": verdict.replay.frames,
        "transitions": len(verdict.replay.transitions),
        "samples": verdict.samples,
        "notes": verdict.notes,
    }
    event = Event(
        actor=ACTOR,
        action=ACTION,
        outcome="done" if verdict.agrees else "failed",
        session_id=session,
        detail=detail,
    )
    with database.write() as db:
        audit.append(db, event)


def _write(verdict: Verdict, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    _write_csv(out / "motion.csv", verdict.motion)
    _write_csv(out / "transitions.csv", verdict.replay.transitions)
    say(f"Written to {out}")


def _write_csv(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    rows = list(rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
