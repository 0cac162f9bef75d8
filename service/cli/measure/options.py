"""Parsers of the options of ``tidegate measure``; a refusal names the option, its value and the expected form."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from engine.core.breath import GateSignal, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.signals import HeadDirection
from engine.gating import HYSTERESIS, AmplitudeWindow, GateWindow, Unit
from engine.motion import NamedRegion, check_regions, load_regions, parse_region
from engine.offline import MeshOptions

CALIBRATION_NAME = "calibration.json"
SUMMARY_NAME = "summary.csv"
MAX_JOBS = 64
WITHOUT_PLACE = (GateSignal.WHOLE, GateSignal.THORAX, GateSignal.ABDOMEN, GateSignal.VOLUME)
HEAD_DIRECTIONS: dict[str, HeadDirection | None] = {
    "auto": None,
    **{side.value: side for side in HeadDirection},
    "up": HeadDirection.TOP,
    "down": HeadDirection.BOTTOM,
}


def point(text: str) -> tuple[int, int]:
    """Read ``ROW,COL``."""
    try:
        row, column = (int(part) for part in text.split(","))
    except ValueError as error:
        raise InvalidValueError("point", text, "ROW,COL, two whole numbers") from error
    return row, column


def split(text: str | None) -> tuple[float, float] | None:
    """Read ``ROW,ROW``: where the line crosses the patient's right and left edge of the region."""
    if text is None:
        return None
    try:
        right, left = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InvalidValueError("split", text, "ROW,ROW, two numbers") from error
    return right, left


def regions(texts: Sequence[str], file: Path | None) -> tuple[NamedRegion, ...]:
    """Read the regions of ``--region`` and then those of the file of ``--regions``."""
    named = tuple(parse_region(text) for text in texts) + (() if file is None else load_regions(file))
    check_regions(named)
    return named


def window(text: str, points: Sequence[tuple[int, int]] = (), named: Sequence[NamedRegion] = ()) -> GateWindow:
    """Read ``SIGNAL:LOWER:UPPER``; the signal may be a point (``pROW_COL``) or a region that are measured too."""
    parts = text.split(":")
    try:
        signal, (lower, upper) = parts[0], (float(part) for part in parts[1:])
    except ValueError as error:
        raise InvalidValueError("window", text, "SIGNAL:LOWER:UPPER, a name and two numbers") from error
    choice = _signal(signal, points, [region.name for region in named])
    unit = Unit.L if choice.is_volume else Unit.MM
    return AmplitudeWindow(choice=choice, lower=lower, upper=upper, unit=unit, hysteresis=HYSTERESIS[unit])


def _signal(text: str, points: Sequence[tuple[int, int]], names: Sequence[str]) -> SignalChoice:
    if text in names:
        return SignalChoice(signal=GateSignal.NAMED, name=text, index=names.index(text))
    columns = [f"p{row}_{column}" for row, column in points]
    if text in columns:
        index = columns.index(text)
        return SignalChoice(signal=GateSignal.POINT, row=points[index][0], column=points[index][1], index=index)
    if text not in WITHOUT_PLACE:
        bound = f"one of {', '.join([*WITHOUT_PLACE, *columns, *names])}; points and regions need --point or --region"
        raise InvalidValueError("window's signal", text, bound)
    return SignalChoice(signal=text)


def head_direction(head: str) -> HeadDirection | None:
    """Read ``--head``; None is automatic."""
    if head not in HEAD_DIRECTIONS:
        raise InvalidValueError("head", head, f"one of {', '.join(HEAD_DIRECTIONS)}")
    return HEAD_DIRECTIONS[head]


def meshes(text: str | None, kind: str) -> MeshOptions:
    """Read ``FRAME,FRAME,...``."""
    try:
        frames = frozenset(int(part) for part in text.split(",")) if text is not None else frozenset[int]()
    except ValueError as error:
        raise InvalidValueError("mesh", text, "FRAME,FRAME,..., whole numbers") from error
    return MeshOptions(frames=frames, kind=kind)


def calibrations(recordings: Sequence[Path], given: Sequence[Path]) -> list[Path]:
    """Return one calibration per recording: a common one, one each, or the file beside each recording."""
    if len(given) == 1:
        return [given[0]] * len(recordings)
    if given:
        if len(given) != len(recordings):
            bound = f"given once, or once for each of the {len(recordings)} recordings"
            raise InvalidValueError("calibration", f"{len(given)} files", bound)
        return list(given)
    return [recording.parent / CALIBRATION_NAME for recording in recordings]


def folders(recordings: Sequence[Path], out: Path) -> list[Path]:
    """Return a separate folder in ``out`` for each recording.

    It has the recording's stem for a name, with its parent's before it where two share the stem, and a number behind it
    where that is still the same. Names that differ in case only are the same: some file systems think so.
    """
    stems = Counter(recording.stem.casefold() for recording in recordings)
    taken = {SUMMARY_NAME}
    names = []
    for recording in recordings:
        is_alone = stems[recording.stem.casefold()] == 1
        wanted = recording.stem if is_alone else f"{recording.absolute().parent.name}-{recording.stem}"
        name, number = wanted, 1
        while name.casefold() in taken:
            number += 1
            name = f"{wanted}-{number}"
        taken.add(name.casefold())
        names.append(name)
    return [out / name for name in names]


def check_jobs(jobs: int, files: int, *, has_scheduler: bool = False) -> int:
    """Return the number of processes: ``jobs``, or one per core if 0; at most one per file."""
    if has_scheduler and jobs != 0:
        raise InvalidValueError("jobs", jobs, "left out with --scheduler: its workers are counted there")
    if not 0 <= jobs <= MAX_JOBS:
        raise InvalidValueError("jobs", jobs, f"from 0 (one per core) to {MAX_JOBS}")
    return min(jobs or len(os.sched_getaffinity(0)), files, MAX_JOBS)
