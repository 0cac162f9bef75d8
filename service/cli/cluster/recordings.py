"""``tidegate measure --scheduler``: jobs made, results put in place."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from engine.offline import FileOutcome, FileTask, Progress
from service.cli.cluster.options import SchedulerOptions
from service.cli.cluster.run import Finished, connected, run_jobs
from service.cli.cluster.worker import MeasureJob


def measure_on_cluster(
    scheduler: SchedulerOptions,
    out: Path,
    tasks: Sequence[FileTask],
    on_progress: Callable[[int, Progress], None],
    on_outcome: Callable[[int, FileOutcome], None],
) -> list[FileOutcome]:
    """Measure recordings with the workers of a cluster; like :func:`engine.offline.batch.measure_files`."""
    outcomes: dict[int, FileOutcome] = {}

    def on_report(position: int, values: dict[str, Any]) -> None:
        on_progress(position, Progress(frames=values["frames"], total=values["total"]))

    def on_finished(position: int, finished: Finished) -> None:
        outcome = _outcome(finished)
        _put_in_place(finished, tasks[position].out)
        outcomes[position] = outcome
        on_outcome(position, outcome)

    with connected(scheduler) as client:
        run_jobs(client, [_job(task) for task in tasks], out, on_report, on_finished)
    return [outcomes[position] for position in range(len(tasks))]


def _job(task: FileTask) -> MeasureJob:
    recording, calibration = task.recording.absolute(), task.calibration.absolute()
    size = recording.stat().st_size if recording.is_file() else None
    return MeasureJob(
        task=replace(task, recording=recording, calibration=calibration, out=task.out.absolute()), recording_bytes=size
    )


def _outcome(finished: Finished) -> FileOutcome:
    if finished.failure is not None:
        return FileOutcome(summary=None, frames=0, seconds=0.0, error=finished.failure)
    return cast("FileOutcome", finished.value)


def _put_in_place(finished: Finished, target: Path) -> None:
    """Move the files of a result; each appears complete."""
    if finished.folder is None or not finished.files:
        return
    target.mkdir(parents=True, exist_ok=True)
    for name in finished.files:
        (finished.folder / name).replace(target / name)
