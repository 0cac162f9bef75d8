"""What is sent to a worker: a recording to measure, or a run of the evaluation. The work is that of one machine.

A job writes into a folder of its own, never where its results belong: a worker that lost its connection may still be
writing when another one does the same job. The client moves the files of the one result that it accepts.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from engine.core.errors import RecordingError
from engine.lab.evaluation.runs.bench import MEASURED, MEASURED_RECIPE, do_run
from engine.lab.evaluation.runs.bench import Progress as RunProgress
from engine.lab.evaluation.runs.datasets import Run, is_made
from engine.lab.evaluation.runs.trial import TrialSettings
from engine.offline.batch import FileOutcome, Progress, measure_file
from engine.offline.measure import FileTask

Report = Callable[[dict[str, int | str]], None]
"""Reports progress; the values travel as MessagePack."""


class ClusterJob(Protocol):
    """A job that reads by path, writes into the folder it is given, and returns a value that can be pickled."""

    def run(self, folder: Path, report: Report) -> object:
        """Do the work."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureJob:
    """A recording to measure; ``recording_bytes`` is its size as the client sees it, None if the client does not."""

    task: FileTask
    recording_bytes: int | None

    def run(self, folder: Path, report: Report) -> FileOutcome:
        """Measure; errors of recording and calibration are part of the outcome."""
        for path in (self.task.recording, self.task.calibration):
            if not path.exists():
                raise RecordingError(f"does not find {path}")
        size = self.task.recording.stat().st_size
        if self.recording_bytes not in {None, size}:
            raise RecordingError(f"finds another file as {self.task.recording}: {size} bytes, {self.recording_bytes}")

        def on_progress(progress: Progress) -> None:
            report({"frames": progress.frames, "total": progress.total})

        return measure_file(replace(self.task, out=folder), on_progress)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationJob:
    """A run of the evaluation; a recording that is complete in the folder ``work`` is used again."""

    planned: Run
    work: Path
    settings: TrialSettings

    def run(self, folder: Path, report: Report) -> None:
        """Make and measure the recording in ``folder/NAME``."""
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
