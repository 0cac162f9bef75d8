"""A bench small enough for tests: one volunteer at ten frames a second, and everybody learns in a hurry."""

from pathlib import Path

from engine.motion.learning.trainer import TrainingSettings
from lab.evaluation.runs.datasets import Run
from lab.evaluation.runs.trial import TrialSettings

SETTINGS = TrialSettings(
    plain_frames=30,
    training=TrainingSettings(min_frames=25, min_cycles=0, min_seconds=2.5, max_seconds=3.0, max_frames=100),
)


def small_run(name="D01", seconds=7.0, **changes) -> Run:
    """A run of 70 frames; the first 30 train the plain method, fewer Tidegate."""
    values = {"group": "table2", "scenario": "regular", "volunteer": 1, "seed": 5, "fps": 10.0}
    return Run(name=name, seconds=seconds, **(values | changes))


def tiny_run(name="D01", **changes) -> Run:
    """A run of ten frames, which teach no one anything."""
    return small_run(name, 2.0, **({"fps": 5.0} | changes))


def files_under(folder: Path) -> list[str]:
    """Every file and folder, relative."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
