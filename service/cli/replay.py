"""``tidegate replay``: a stored session once more, from what its engine heard and saw."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from engine.errors import TidegateError
from service.audit import Event
from service.cli.terminal import advance, frame_bar, refused, say
from service.db.engine import Database
from service.db.place import DATABASE_NAME
from service.session_replay import StoredSession, Verdict
from service.settings import SettingsError, load_settings

DIFFERENT = 1
ACTION = "session.replayed"
ACTOR = "tidegate replay"


def replay(
    session: Annotated[str, typer.Argument(help="The session's id.", metavar="SESSION")],
    data: Annotated[
        Path | None,
        typer.Option(
            help="A data folder to read, such as a copy or a restored backup: nothing is written into its audit. "
            "When left out, the service's own, whose audit is told of the replay."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for motion.csv and transitions.csv.")] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Where the recording lies now, if not where it was played from.")
    ] = None,
    *,
    any_version: Annotated[
        bool, typer.Option("--any-version", help="Replay a session that ran as another version of the software.")
    ] = False,
) -> None:
    """Run a stored session again and compare every gate edge and every sample with what was recorded, to the last bit.

    Exit code 0 where all is identical, 1 where something differs, 2 where the session cannot be replayed.
    """
    try:
        database, data_dir, is_own = _opened(data)
        try:
            stored = StoredSession(database, data_dir, session)
            if not any_version:
                stored.refuse_other_version()
            verdict = _run(stored, recording)
            _tell(verdict)
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
    if not verdict.is_identical:
        raise typer.Exit(DIFFERENT)


def _opened(data: Path | None) -> tuple[Database, Path, bool]:
    """Open a folder's database, never making one."""
    if data is None:
        settings = load_settings()
        place, data_dir = settings.database_place, settings.data_dir
    else:
        place, data_dir = data / DATABASE_NAME, data
    if isinstance(place, Path) and not place.is_file():
        raise refused("replay", f"{place}: there is no database")
    return Database(place), data_dir, data is None


def _run(stored: StoredSession, recording: Path | None) -> Verdict:
    with frame_bar() as bar:
        shown = bar.add_task("replaying", total=stored.survey.frames)
        return stored.run_again(recording, lambda frames: advance(bar, shown, frames))


def _tell(verdict: Verdict) -> None:
    for note in verdict.notes:
        say(f"Mind: {note}", "yellow")
    if verdict.is_identical:
        told = verdict.replay
        typer.echo(
            f"identical: {told.frames} frames, {len(told.transitions) + len(told.elsewhere)} transitions "
            f"({verdict.audited} in the audit), {verdict.samples} samples"
        )
        return
    for difference in verdict.differences:
        place = "before the first frame" if difference.frame is None else f"at frame {difference.frame}"
        typer.echo(f"DIFFERENT {place}, after {verdict.replay.frames} identical frames")
        typer.echo(f"  recorded: {difference.recorded}")
        typer.echo(f"  replayed: {difference.replayed}")


def _audit(database: Database, session: str, verdict: Verdict) -> None:
    from service import audit

    detail: dict[str, object] = {
        "is_identical": verdict.is_identical,
        "frames": verdict.replay.frames,
        "transitions": len(verdict.replay.transitions),
        "samples": verdict.samples,
        "notes": verdict.notes,
    }
    event = Event(
        actor=ACTOR,
        action=ACTION,
        outcome="done" if verdict.is_identical else "failed",
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
