"""The monitor on recorded breathing; for an RPM export also its agreement with the RPM's own flags and phases."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.core.breath import BreathEventKind
from engine.core.errors import InvalidValueError, RecordingError
from engine.core.frames import BoolArray, FloatArray
from engine.qa.recorded_traces import FLAG_LOST, read_trace
from lab.evaluation.breathing.trials import MonitorOutput, run_monitor

NOT_PERIODIC = -2
ZEROS = ("inhale", "exhale")


@dataclass(frozen=True, slots=True, kw_only=True)
class RpmConventions:
    """Conventions of an RPM's export, which differ between versions.

    Attributes
    ----------
    not_periodic
        Flag of samples that are not periodic.
    zero
        End of the breath at which its phase is 0: ``inhale`` or ``exhale``.
    """

    not_periodic: int = NOT_PERIODIC
    zero: str = "inhale"

    def __post_init__(self) -> None:
        """Raise InvalidValueError if a value is out of bounds."""
        if self.zero not in ZEROS:
            raise InvalidValueError("rpm_zero", self.zero, "inhale or exhale")
        if not -9 <= self.not_periodic <= 9 or self.not_periodic == FLAG_LOST:
            raise InvalidValueError("rpm_flag", self.not_periodic, f"from -9 to 9, and not {FLAG_LOST}, which is lost")


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Agreement on irregular samples: shares of all samples, Cohen's kappa, and mean and 95 % phase difference [%].

    ``ours`` names the criterion by which our monitor's samples count as irregular.
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
class MonitoredTrace:
    """A recorded trace with the monitor's output."""

    name: str
    time_s: FloatArray
    value_mm: FloatArray
    output: MonitorOutput
    rpm: tuple[Agreement, ...] = ()

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time_s[-1])


def monitor_trace(path: Path, conventions: RpmConventions) -> MonitoredTrace:
    """Run the monitor on a recorded trace.

    Raises
    ------
    RecordingError
        The file cannot be read.
    """
    trace = read_trace(path)
    output = run_monitor(trace.time_s, trace.motion_mm)
    rpm: tuple[Agreement, ...] = ()
    if trace.kind == "rpm":
        flags, phase_percent = _read_rpm_columns(path)
        if len(flags) != len(trace.time_s):
            raise RecordingError(f"{path.name}: has {len(flags)} flags for {len(trace.time_s)} samples")
        turn = 0.0 if conventions.zero == "inhale" else 50.0
        rpm = _agreements(trace.time_s, output, flags == conventions.not_periodic, (phase_percent + turn) % 100.0)
    return MonitoredTrace(name=path.name, time_s=trace.time_s, value_mm=trace.motion_mm, output=output, rpm=rpm)


def _agreements(
    time_s: FloatArray, output: MonitorOutput, is_not_periodic: BoolArray, phase_percent: FloatArray
) -> tuple[Agreement, ...]:
    """Compare the samples after the monitor's first phase: before, it learns the breath."""
    unknown = np.isnan(output.phase_percent)
    if unknown.all():
        return ()
    learned = slice(int(np.argmin(unknown)), None)
    has_event = np.zeros(len(time_s), dtype=bool)
    for kind in BreathEventKind:
        has_event |= output.during(kind, time_s)
    difference = np.abs((output.phase_percent - phase_percent + 50.0) % 100.0 - 50.0)
    return tuple(
        compare_flags(ours, fault[learned], is_not_periodic[learned], difference[learned])
        for ours, fault in (("no phase", unknown), ("no phase, or an event", unknown | has_event))
    )


def compare_flags(ours: str, fault: BoolArray, is_not_periodic: BoolArray, apart_percent: FloatArray) -> Agreement:
    """Compare irregular samples, arrays of shape (n,); ``apart_percent`` is NaN where there is no phase."""
    both, neither = float((fault & is_not_periodic).mean()), float((~fault & ~is_not_periodic).mean())
    chance = fault.mean() * is_not_periodic.mean() + (1.0 - fault.mean()) * (1.0 - is_not_periodic.mean())
    difference = apart_percent[~fault & ~is_not_periodic & np.isfinite(apart_percent)]
    return Agreement(
        ours=ours,
        both=both,
        theirs_only=float((~fault & is_not_periodic).mean()),
        ours_only=float((fault & ~is_not_periodic).mean()),
        neither=neither,
        kappa=float((both + neither - chance) / (1.0 - chance)) if chance < 1.0 else 1.0,
        phase_error=float(difference.mean()) if difference.size else None,
        phase_error_95=float(np.percentile(difference, 95)) if difference.size else None,
    )


def _read_rpm_columns(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return flag and phase [%] of every sample that is not lost; the file is valid, `read_trace` has read it."""
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
