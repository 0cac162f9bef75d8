"""The benchmark's recording: made once in a folder, and reused if it is complete and its recipe is unchanged."""

import shutil
from collections.abc import Callable
from pathlib import Path

from engine.lab.evaluation.runs.datasets import fingerprint, is_made, write_recipe
from engine.lab.phantom.recording import make_volunteer

SCENARIO, VOLUNTEER, SEED, FPS = "regular", 1, 1, 30.0
FOLDER = "speed-recording"


def make_recording(work: Path, seconds: float, on_progress: Callable[[int, int], None]) -> Path:
    """Return the recording's folder within ``work``; make it if it is missing, incomplete or of another recipe."""
    folder = work / FOLDER
    recipe: dict[str, object] = {
        "scenario": SCENARIO,
        "volunteer": VOLUNTEER,
        "seed": SEED,
        "seconds": seconds,
        "fps": FPS,
        "phantom": fingerprint("lab/phantom/*.py"),
    }
    if is_made(folder, recipe):
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    make_volunteer(
        SCENARIO, volunteer=VOLUNTEER, seconds=seconds, fps=FPS, seed=SEED, out=folder, on_progress=on_progress
    )
    write_recipe(folder, recipe)
    return folder
