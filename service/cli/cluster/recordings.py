"""``tidegate measure --scheduler`` and ``tidegate evaluate --scheduler``: jobs made, results put in place."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from engine.core.errors import RecordingError
from engine.lab.evaluation.runs.bench import Progress as RunProgress, Report
from engine.lab.evaluation.runs.datasets import RECIPE, Run
from engine.lab.evaluation.runs.trial import TrialSettings
from engine.offline import FileOutcome, FileTask, Progress
from service.cli.cluster.options import SchedulerOptions
from service.cli.cluster.run import Finished, connected, run_jobs
from service.cli.cluster.worker import EvaluationJob, MeasureJob


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


def evaluate_on_cluster(
    scheduler: SchedulerOptions, runs: list[Run], work: Path, settings: TrialSettings, report: Report
) -> None:
    """Make and measure the evaluation's runs with the workers of a cluster.

    Raises
    ------
    RecordingError
        A run could not be done; the others are kept.
    """
    failures: list[str] = []
    jobs = [EvaluationJob(planned=run, work=work.absolute(), settings=settings) for run in runs]

    def on_report(position: int, values: dict[str, Any]) -> None:
        if values["doing"] != "done":  # done is what the client has put in place
            report(RunProgress(run=runs[position].name, doing=values["doing"], frames_done=values["frames"]))

    def on_finished(position: int, finished: Finished) -> None:
        run = runs[position]
        if finished.failure is not None:
            failures.append(f"{run.name}: {finished.failure}")
        else:
            _keep_run(finished, work / run.name)
        report(RunProgress(run=run.name, doing="done", frames_done=2 * run.frames))

    with connected(scheduler) as client:
        run_jobs(client, jobs, work, on_report, on_finished)
    if failures:
        raise RecordingError("; ".join(failures))


def _keep_run(finished: Finished, target: Path) -> None:
    """Move a run's folder where it belongs, or only its measurement where the recording was there before."""
    assert finished.folder is not None, "a run that did not fail has a folder"
    made = finished.folder / target.name
    if f"{target.name}/{RECIPE}" in finished.files:
        shutil.rmtree(target, ignore_errors=True)
        made.replace(target)
        return
    names = [Path(name).name for name in finished.files]
    for name in sorted(names, key=lambda name: name.endswith(".json")):  # the recipe last: it says complete
        (made / name).replace(target / name)
