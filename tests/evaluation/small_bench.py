"""A bench small enough for tests: one volunteer at ten frames a second, and everybody learns in a hurry."""

from pathlib import Path

from engine.evaluation.datasets import Run
from engine.evaluation.trial import TrialSettings
from engine.training import TrainingSettings

SETTINGS = TrialSettings(
    plain_frames=45,
    training=TrainingSettings(min_frames=40, min_cycles=0, min_seconds=4.0, max_seconds=6.0, max_frames=200),
)


def small_run(name="D01", seconds=11.0, **changes) -> Run:
    """A run of 110 frames; the first 46 teach the plain reading, fewer Tidegate."""
    values = {"group": "table2", "scenario": "regular", "volunteer": 1, "seed": 5, "fps": 10.0}
    return Run(name=name, seconds=seconds, **(values | changes))


def files_under(folder: Path) -> list[str]:
    """Every file and folder, relative."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
