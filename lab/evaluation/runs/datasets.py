"""Recordings of the evaluation: fifteen datasets of ten volunteers as in the article's Tables 1 and 2, and more.

A recording is made on demand and cached. Its parameters are stored in ``recipe.json``, which is written last: a folder
without a recipe, or with a different one, is made again.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from engine.core.bounds import check_number, check_whole_number
from engine.core.files import write_whole
from engine.offline.result_files import fingerprint
from lab.phantom.builds import NO_DEPARTURE, Departure
from lab.phantom.falsifications import Falsification, Move
from lab.phantom.recording import make_volunteer
from lab.phantom.sensor import BENCHED, USUAL, find_sensor

SCHEMA = "tidegate.bench/1"
SEED = 2017
SECONDS = 32.0
LONG_SECONDS = 53.0
SHORTEST_S, LONGEST_S = 28.0, 120.0
RECIPE = "recipe.json"

# Volunteer of each dataset: the article's Table 1.
VOLUNTEERS = (1, 1, 2, 3, 3, 4, 4, 5, 6, 7, 7, 8, 8, 9, 10)
LONG = ("D01", "D10")
"""Datasets of 52 s, as in the article's Figure 16: 350 frames at its rate."""

LOCKING = "locking"
WHOLE = ("regular", "irregular", "shift", "dibh", "isovolume", "drift")
USUAL_WHOLE = ("D04", "D10", "I03", "S01", "S03", "H01", "V01", "V02", "G01")
"""The recordings of the usual sensor that stand beside those of the second one."""

COUCH_DOWN_MM, COUCH_S = 2.0, 22.0
"""How far, and when, the couch goes down under a patient who shifts at the same time."""

SWEEP_VOLUNTEER = 1
SWEEP_SECONDS = 24.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One recording of the evaluation.

    Attributes
    ----------
    group
        ``table2`` for the fifteen datasets, the scenario for the others; ``distance``, ``amplitude``, ``rate`` or
        ``holes`` for a point of a sweep, whose value is ``setting``.
    is_long
        Also measured with one component (Figures 16 and 17).
    has_instruments
        Whether a laser line is in view.
    is_lowered
        Whether the couch goes down by `COUCH_DOWN_MM`, at `COUCH_S`.
    is_pictured
        Also measured with the bilateral filter alone; its pictures are stored (Figures 8 and 14).
    """

    name: str
    group: str
    scenario: str
    volunteer: int
    seed: int
    seconds: float
    fps: float = 30.0
    departure: Departure = NO_DEPARTURE
    sensor: str = USUAL
    setting: float | None = None
    is_long: bool = False
    is_pictured: bool = False
    has_instruments: bool = True
    is_lowered: bool = False

    @property
    def falsification(self) -> Falsification | None:
        """The couch's movement; the floor stays."""
        if not self.is_lowered:
            return None
        return Falsification(start_s=COUCH_S, camera=Move(up_mm=-COUCH_DOWN_MM), floor_stays=True)

    def lowered_mm(self, time_s: float) -> float:
        """How far the couch is below where it was at this time [mm]: the patient's surface is as much farther away."""
        false = self.falsification
        elapsed_s = None if false is None else false.elapsed_s(time_s)
        if false is None or false.camera is None or elapsed_s is None:
            return 0.0
        return false.camera.pose(elapsed_s).z_mm

    @property
    def is_sweep(self) -> bool:
        """Whether it is a point of a sweep."""
        return self.setting is not None

    @property
    def has_laser(self) -> bool:
        """Whether the recording contains a laser line; a sweep does not need one."""
        return not self.is_sweep and self.has_instruments

    @property
    def is_measured_whole(self) -> bool:
        """Whether it is also measured whole, in two passes, beside the smoothed PCA of all frames."""
        return not self.is_sweep and self.scenario in WHOLE and (self.sensor != USUAL or self.name in USUAL_WHOLE)

    @property
    def frames(self) -> int:
        """Approximate number of depth frames."""
        return int(self.seconds * self.fps)

    @property
    def recipe(self) -> dict[str, object]:
        """Parameters that determine the recording, with the fingerprint of the code that makes it."""
        return {
            "schema": SCHEMA,
            "scenario": self.scenario,
            "volunteer": self.volunteer,
            "seed": self.seed,
            "seconds": self.seconds,
            "fps": self.fps,
            "departure": asdict(self.departure),
            "has_laser": self.has_laser,
            "sensor": self.sensor,
            "is_lowered": self.is_lowered,
            "phantom": fingerprint("lab/phantom/*.py"),
        }


def _lowered(seed: int) -> list[Run]:
    """Return a patient who shifts while the couch goes down, on each sensor."""
    return [
        Run(
            name=name,
            group="couch",
            scenario="shift",
            volunteer=volunteer,
            seed=seed + 400 + volunteer,
            seconds=34.0,
            sensor=sensor,
            has_instruments=False,
            is_lowered=True,
        )
        for name, volunteer, sensor in (("S03", 4, USUAL), ("L09", 7, LOCKING))
    ]


def full_plan(seed: int = SEED, seconds: float = SECONDS) -> list[Run]:
    """Return all runs: the fifteen datasets, the article's other experiments and the sweeps; the longest first."""
    runs = [*_table2(seed, seconds), *_others(seed), *_second_sensor(seed), *_lowered(seed), *_sweeps(seed)]
    return sorted(runs, key=lambda run: -run.frames)


def quick_plan(seed: int = SEED, seconds: float = SECONDS) -> list[Run]:
    """Return three datasets of three volunteers, the first with all methods and pictures."""
    return [run for run in _table2(seed, seconds, long=()) if run.name in {"D01", "D06", "D10"}]


def accuracy_plan(seed: int = SEED, seconds: float = SECONDS, sensor: str = "") -> list[Run]:
    """Return the runs that are measured whole: each kind of breathing, on both sensors; the longest first.

    With a ``sensor`` of another kind, those of the second sensor, recorded by that one.
    """
    if sensor and sensor not in BENCHED:
        find_sensor(sensor)
        return [replace(run, name=f"{run.name}-{sensor}", sensor=sensor) for run in _second_sensor(seed)]
    plan = [run for run in full_plan(seed, seconds) if run.is_measured_whole]
    return [run for run in plan if sensor in {"", run.sensor}]


def check_plan(seed: int, seconds: float) -> None:
    """Raise InvalidValueError naming field, value and bound if seed or length [s] is out of bounds."""
    check_whole_number("seed", seed, 0, 2**31)
    check_number("seconds", seconds, SHORTEST_S, LONGEST_S)


def _table2(seed: int, seconds: float, long: tuple[str, ...] = LONG) -> list[Run]:
    runs = []
    for number, volunteer in enumerate(VOLUNTEERS, start=1):
        name = f"D{number:02d}"
        runs.append(
            Run(
                name=name,
                group="table2",
                scenario="regular",
                volunteer=volunteer,
                seed=seed + number,
                seconds=max(seconds, LONG_SECONDS) if name in long else seconds,
                is_long=name in long,
                is_pictured=name == "D01",
            )
        )
    return runs


def _others(seed: int) -> list[Run]:
    """Return two or three runs each of irregular breathing, isovolume manoeuvre, breath hold and patient shift."""
    scenarios = (
        ("I01", "irregular", 1, LONG_SECONDS, True),
        ("I02", "irregular", 4, LONG_SECONDS, True),
        ("I03", "irregular", 10, 32.0, False),
        ("V01", "isovolume", 1, 38.0, False),
        ("V02", "isovolume", 7, 38.0, False),
        ("H01", "dibh", 1, 40.0, False),
        ("H02", "dibh", 4, 40.0, False),
        ("S01", "shift", 1, 34.0, False),
        ("S02", "shift", 10, 34.0, False),
        ("G01", "drift", 1, 40.0, False),
    )
    return [
        Run(
            name=name,
            group=scenario,
            scenario=scenario,
            volunteer=volunteer,
            seed=seed + 100 + position,
            seconds=seconds,
            is_long=is_long,
        )
        for position, (name, scenario, volunteer, seconds, is_long) in enumerate(scenarios)
    ]


def _second_sensor(seed: int) -> list[Run]:
    """Return a recording or two of each kind of breathing on the sensor whose errors follow the sub-pixel phase."""
    scenarios = (
        ("L01", "table2", "regular", 3, 32.0),
        ("L02", "table2", "regular", 7, 32.0),
        ("L03", "irregular", "irregular", 5, 40.0),
        ("L04", "shift", "shift", 3, 34.0),
        ("L05", "dibh", "dibh", 3, 40.0),
        ("L06", "isovolume", "isovolume", 3, 38.0),
        ("L07", "isovolume", "isovolume", 8, 38.0),
        ("L08", "drift", "drift", 6, 40.0),
    )
    return [
        Run(
            name=name,
            group=group,
            scenario=scenario,
            volunteer=volunteer,
            seed=seed + 300 + position,
            seconds=seconds,
            sensor=LOCKING,
            has_instruments=False,
        )
        for position, (name, group, scenario, volunteer, seconds) in enumerate(scenarios)
    ]


def _sweeps(seed: int) -> list[Run]:
    """Return the sweeps: one volunteer, one seed, one parameter changed at a time."""
    points: list[tuple[str, float, Departure, float]] = []
    points += [("distance", mm, Departure(camera_mm=mm), 30.0) for mm in (600.0, 900.0, 1200.0)]
    points += [("amplitude", mm, Departure(amplitude_mm=mm), 30.0) for mm in (2.0, 10.0, 40.0)]
    points += [("rate", fps, NO_DEPARTURE, fps) for fps in (10.0, 15.0, 30.0)]
    points += [("holes", share, Departure(hole_share=share), 30.0) for share in (0.0, 0.4, 0.6)]
    return [
        Run(
            name=f"{group}-{value:g}",
            group=group,
            scenario="regular",
            volunteer=SWEEP_VOLUNTEER,
            seed=seed + 200,
            seconds=SWEEP_SECONDS,
            fps=fps,
            departure=departure,
            setting=value,
        )
        for group, value, departure, fps in points
    ]


def make_dataset(run: Run, folder: Path, on_progress: Callable[[int, int], None]) -> None:
    """Make a run's recording in ``folder``, unless it is complete and has the same recipe."""
    if is_made(folder, run.recipe):
        return
    shutil.rmtree(folder, ignore_errors=True)
    make_volunteer(
        run.scenario,
        volunteer=run.volunteer,
        seconds=run.seconds,
        fps=run.fps,
        seed=run.seed,
        departure=run.departure,
        has_laser=run.has_laser,
        sensor=run.sensor,
        falsification=run.falsification,
        out=folder,
        workers=1,
        on_progress=on_progress,
    )
    write_recipe(folder, run.recipe)


def is_made(folder: Path, recipe: dict[str, object], name: str = RECIPE) -> bool:
    """Whether the folder is complete and was made with this recipe."""
    try:
        return bool(json.loads((folder / name).read_text(encoding="utf-8")) == json.loads(json.dumps(recipe)))
    except (OSError, ValueError):
        return False


def write_recipe(folder: Path, recipe: dict[str, object], name: str = RECIPE) -> None:
    """Mark the folder as complete: write its recipe atomically."""
    write_whole(folder / name, json.dumps(recipe, indent=1, sort_keys=True).encode())
