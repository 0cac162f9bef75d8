"""``tidegate evaluate --scheduler``: a run of the evaluation is a job, and its result is put in place."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.core.errors import RecordingError
from engine.offline import fingerprint
from lab.evaluation.runs.bench import MEASURED, MEASURED_RECIPE, Progress as RunProgress, Report, do_run
from lab.evaluation.runs.datasets import RECIPE, Run, is_made
from lab.evaluation.runs.trial import TrialSettings
from service.cli.cluster.options import SchedulerOptions
from service.cli.cluster.run import Finished, connected, run_jobs
from service.cli.cluster.worker import Report as JobReport

CODE = "lab/**/*.py"
"""What is sent as a job: a glob of `fingerprint`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationJob:
    """A run of the evaluation; a recording that is complete in the folder ``work`` is used again.

    ``code`` is the client's: a worker with another lab raises RecordingError.
    """

    planned: Run
    work: Path
    settings: TrialSettings
    code: str

    def run(self, folder: Path, report: JobReport) -> None:
        """Make and measure the recording in ``folder/NAME``."""
        if fingerprint(CODE) != self.code:
            raise RecordingError("has another source of tidegate-lab than this client")
        kept = self.work / self.planned.name
        if is_made(kept, self.planned.recipe):
            stage = folder / self.planned.name
            stage.mkdir()
            for path in kept.iterdir():
                if path.name not in {MEASURED, MEASURED_RECIPE}:
                    (stage / path.name).symlink_to(path)

        def on_progress(progress: RunProgress) -> None:
            report({"doing": progress.doing, "frames": progress.frames_done})

        do_run(self.planned, folder, self.settings, on_progress)


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
    code = fingerprint(CODE)
    jobs = [EvaluationJob(planned=run, work=work.absolute(), settings=settings, code=code) for run in runs]

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
