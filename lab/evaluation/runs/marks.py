"""Accuracy targets ("marks") of the measurement, and whether they are met."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from lab.evaluation.runs.scores import Score, ScoredRun
from lab.evaluation.table import Table
from lab.phantom.sensor import BENCHED, USUAL

CELLS_MM = {"table2": 0.16, "irregular": 0.16, "shift": 0.16, "dibh": 0.30, "isovolume": 0.20}
_NAMES = {
    "table2": "regular breathing",
    "irregular": "irregular breathing",
    "shift": "after a shift of the patient",
    "couch": "shift while the couch goes down",
    "dibh": "in breath holds",
    "isovolume": "isovolume manoeuvre",
    "drift": "drifting baseline",
}
LEAST_SHARE = 0.99
WHOLE_MM = {
    "table2": (0.10, 0.07),
    "irregular": (0.10, 0.07),
    "shift": (0.11, 0.07),
    "couch": (0.11, 0.07),
    "dibh": (0.11, 0.08),
    "isovolume": (0.15, 0.08),
    "drift": (0.11, 0.08),
}
"""Required of a recording measured whole: mean error of the cells, and with each cell's constant taken off."""
REGION_MM, WORST_FRAME_MM = 0.04, 0.30
"""Required of every recording measured whole: error of the whole region, and mean over the cells of its worst frame."""
LIVE_MM = 0.06
"""Required of live measurement: mean error of the whole region."""
STEREO = "active-stereo"
STEREO_MM = (0.20, 0.06)
"""Required on active stereo at 0.85 m: mean error of the cells, and of the whole region."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One target.

    Attributes
    ----------
    value, worst
        The value that is compared with the bound, over all recordings of the target; and the worst recording's.
    is_least
        Whether the bound is a minimum; otherwise it is a maximum.
    """

    name: str
    bound: float
    value: float
    worst: float
    worst_run: str
    recordings: int
    is_least: bool = False

    @property
    def is_met(self) -> bool:
        """Whether the target is met; never for NaN."""
        return self._reaches(self.value)

    @property
    def verdict(self) -> str:
        """Verdict in words: a target may be met in the mean and missed by single recordings."""
        if not self.is_met:
            return "MISSED"
        return "met" if self._reaches(self.worst) else f"met, not by {self.worst_run}"

    def _reaches(self, value: float) -> bool:
        return value >= self.bound if self.is_least else value <= self.bound


def reach(scored: list[ScoredRun]) -> list[Mark]:
    """Compare the scores with every target that has recordings."""
    usual = [one for one in scored if one.run.sensor == USUAL]
    return [mark for mark in (*_whole_marks(scored), *_stereo_marks(scored), *_live_marks(usual)) if mark.recordings]


def _whole_marks(scored: list[ScoredRun]) -> list[Mark]:
    marks = []
    for sensor in BENCHED:
        for group, (bound, left) in WHOLE_MM.items():
            ran = [one for one in _in(scored, group) if one.run.sensor == sensor and one.run.is_measured_whole]
            name = f"Recording measured whole, sensor {sensor}, {_NAMES[group]}"
            marks.append(_mark(f"{name} [mm]", bound, ran, lambda s: s.cells_mm, of=_offline))
            marks.append(_mark(f"{name}, constants out [mm]", left, ran, lambda s: s.constants_out_mm, of=_offline))
        every = [one for one in scored if one.run.sensor == sensor and one.run.is_measured_whole]
        name = f"Recording measured whole, sensor {sensor}, largest of all"
        marks.append(_mark(f"{name}, whole region [mm]", REGION_MM, every, lambda s: s.whole_mm, np.max, of=_offline))
        marks.append(
            _mark(f"{name}, worst frame [mm]", WORST_FRAME_MM, every, lambda s: s.worst_frame_mm, np.max, of=_offline)
        )
    return marks


def _stereo_marks(scored: list[ScoredRun]) -> list[Mark]:
    marks = []
    for group in ("table2", "irregular"):
        ran = [one for one in _in(scored, group) if one.run.sensor == STEREO and one.run.is_measured_whole]
        name = f"Recording measured whole, sensor {STEREO}, {_NAMES[group]}"
        marks.append(_mark(f"{name} [mm]", STEREO_MM[0], ran, lambda s: s.cells_mm, of=_offline))
        marks.append(_mark(f"{name}, whole region [mm]", STEREO_MM[1], ran, lambda s: s.whole_mm, of=_offline))
    return marks


def _live_marks(scored: list[ScoredRun]) -> list[Mark]:
    marks = [
        _mark(f"Whole ROI, cells of 10 px, {_NAMES[group]} [mm]", bound, _in(scored, group), lambda s: s.cells_mm)
        for group, bound in CELLS_MM.items()
    ]
    fifteen = list(_in(scored, "table2"))
    marks += [
        _mark("Five points, mean [mm]", 0.16, fifteen, lambda s: float(np.mean(s.points_mm))),
        _mark("Five points, largest of all [mm]", 0.8, fifteen, lambda s: max(s.points_max_mm), np.max),
        _mark("Whole-ROI mean motion [mm]", LIVE_MM, fifteen, lambda s: s.whole_mm),
        _mark("Volume, correlation", 0.995, fifteen, lambda s: s.volume_correlation, is_least=True),
        _mark(
            "Isovolume: thorax against abdomen, correlation",
            -0.99,
            _in(scored, "isovolume"),
            lambda s: s.halves_correlation,
        ),
    ]
    return marks


def marks_table(marks: list[Mark]) -> Table:
    """Return the targets as a table; missed rows are marked as failed."""
    rows = tuple(
        (
            mark.name,
            f"{'≥' if mark.is_least else '≤'} {mark.bound:g}",
            mark.value,
            mark.worst,
            mark.worst_run,
            mark.recordings,
            mark.verdict,
        )
        for mark in marks
    )
    return Table(
        name="marks",
        title="Accuracy targets",
        columns=("mark", "bound", "ours", "worst recording", "which", "recordings", "verdict"),
        rows=rows,
        digits=3,
        note="The mean over the recordings is compared with the bound (the largest where stated); the worst recording "
        "is given as well. Breath holds, isovolume and shift include only the frames of the event.",
        failed=frozenset(number for number, mark in enumerate(marks) if not mark.is_met),
    )


def _live(one: ScoredRun) -> Score | None:
    return one.event_scores.get("ours")


def _offline(one: ScoredRun) -> Score | None:
    """Return the score over every frame; None where more than 1 % of an honest recording was lost."""
    return one.whole_scores.get("offline") if one.whole_share.get("offline", 0.0) >= LEAST_SHARE else None


def _in(scored: list[ScoredRun], group: str) -> list[ScoredRun]:
    return [one for one in scored if one.run.group == group]


def _mark(
    name: str,
    bound: float,
    scored: Iterable[ScoredRun],
    value_of: Callable[[Score], float],
    over: Callable[[list[float]], object] = np.mean,
    *,
    is_least: bool = False,
    of: Callable[[ScoredRun], Score | None] = _live,
) -> Mark:
    """Summarise the recordings by ``over``; a recording without a measurement is NaN and misses the target."""
    values = {one.run.name: float("nan") if (score := of(one)) is None else value_of(score) for one in scored}
    if not values:
        return Mark(name=name, bound=bound, value=float("nan"), worst=float("nan"), worst_run="", recordings=0)
    sign = -1.0 if is_least else 1.0
    worst_run = max(values, key=lambda key: np.inf if np.isnan(values[key]) else sign * values[key])
    return Mark(
        name=name,
        bound=bound,
        value=float(np.asarray(over(list(values.values())))),
        worst=values[worst_run],
        worst_run=worst_run,
        recordings=len(values),
        is_least=is_least,
    )
