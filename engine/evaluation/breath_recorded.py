"""Recorded breathing: what is told of it, and for an RPM's export how that agrees with the RPM's own judgement."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.breath import BreathEventKind
from engine.errors import InvalidValueError, RecordingError
from engine.evaluation.breath_trials import Told, listen
from engine.frames import BoolArray, FloatArray
from engine.phantom.traces import FLAG_LOST, read_trace

NOT_PERIODIC = -2
ZEROS = ("inhale", "exhale")


@dataclass(frozen=True, slots=True, kw_only=True)
class RpmSense:
    """How an RPM's export is meant: readers disagree.

    Attributes
    ----------
    not_periodic
        The flag of samples that are not periodic.
    zero
        At which end of the breath its phase is 0: ``inhale`` or ``exhale``.
    """

    not_periodic: int = NOT_PERIODIC
    zero: str = "inhale"

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        if self.zero not in ZEROS:
            raise InvalidValueError("rpm_zero", self.zero, "inhale or exhale")
        if not -9 <= self.not_periodic <= 9 or self.not_periodic == FLAG_LOST:
            raise InvalidValueError("rpm_flag", self.not_periodic, f"from -9 to 9, and not {FLAG_LOST}, which is lost")


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Shares of samples by who finds fault with the breath, Cohen's kappa, and how far phases are apart [%].

    ``ours`` says what counts as a fault of ours.
    """

    ours: str
    both: float
    theirs_only: float
    ours_only: float
    neither: float
    kappa: float
    phase_error: float | None
    phase_error_95: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """A recorded trace and what was told of it."""

    name: str
    time_s: FloatArray
    value_mm: FloatArray
    told: Told
    rpm: tuple[Agreement, ...] = ()

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return float(self.time_s[-1])


def listen_to(path: Path, sense: RpmSense) -> Recorded:
    """Follow a recorded trace.

    Raises
    ------
    RecordingError
        It cannot be read.
    """
    trace = read_trace(path)
    told = listen(trace.time_s, trace.motion_mm)
    rpm: tuple[Agreement, ...] = ()
    if trace.kind == "rpm":
        flags, phase_percent = _rpm_columns(path)
        if len(flags) != len(trace.time_s):
            raise RecordingError(f"{path.name}: has {len(flags)} flags for {len(trace.time_s)} samples")
        turn = 0.0 if sense.zero == "inhale" else 50.0
        rpm = _agreements(trace.time_s, told, flags == sense.not_periodic, (phase_percent + turn) % 100.0)
    return Recorded(name=path.name, time_s=trace.time_s, value_mm=trace.motion_mm, told=told, rpm=rpm)


def _agreements(
    time_s: FloatArray, told: Told, is_not_periodic: BoolArray, phase_percent: FloatArray
) -> tuple[Agreement, ...]:
    """Compare from the first phase on: before, the monitor learns."""
    unknown = np.isnan(told.phase_percent)
    if unknown.all():
        return ()
    learned = slice(int(np.argmin(unknown)), None)
    has_event = np.zeros(len(time_s), dtype=bool)
    for kind in BreathEventKind:
        has_event |= told.during(kind, time_s)
    apart = np.abs((told.phase_percent - phase_percent + 50.0) % 100.0 - 50.0)
    return tuple(
        agree(ours, fault[learned], is_not_periodic[learned], apart[learned])
        for ours, fault in (("no phase", unknown), ("no phase, or an event", unknown | has_event))
    )


def agree(ours: str, fault: BoolArray, is_not_periodic: BoolArray, apart_percent: FloatArray) -> Agreement:
    """Compare sample by sample, arrays of shape (n,); ``apart_percent`` is NaN where no phase is told."""
    both, neither = float((fault & is_not_periodic).mean()), float((~fault & ~is_not_periodic).mean())
    chance = fault.mean() * is_not_periodic.mean() + (1.0 - fault.mean()) * (1.0 - is_not_periodic.mean())
    apart = apart_percent[~fault & ~is_not_periodic & np.isfinite(apart_percent)]
    return Agreement(
        ours=ours,
        both=both,
        theirs_only=float((~fault & is_not_periodic).mean()),
        ours_only=float((fault & ~is_not_periodic).mean()),
        neither=neither,
        kappa=float((both + neither - chance) / (1.0 - chance)) if chance < 1.0 else 1.0,
        phase_error=float(apart.mean()) if apart.size else None,
        phase_error_95=float(np.percentile(apart, 95)) if apart.size else None,
    )


def _rpm_columns(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return flag and phase [%] of every sample that is not lost; the file has been read as a trace before."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    layout = next(line for line in lines if line.lower().startswith("data_layout"))
    names = [name.strip().lower() for name in layout.partition("=")[2].split(",")]
    if "phase" not in names:
        raise RecordingError(f"{path.name}: Data_layout has no phase")
    first = next(number for number, line in enumerate(lines) if line.strip().lower() == "[data]") + 1
    rows = [line.split(",") for line in lines[first:] if line.strip()]
    try:
        columns = [[float(row[names.index(name)]) for row in rows] for name in ("validflag", "phase")]
    except ValueError as error:
        raise RecordingError(f"{path.name}: phase: {error}") from error
    flags, phase = np.array(columns)
    seen = flags != FLAG_LOST
    return flags[seen], phase[seen] / (2.0 * np.pi) * 100.0
