"""Tables of the breathing evaluation: detected events and their delays, false alarms, and errors of the phase.

Draws a signal with the monitor's output: baseline, phase, and bars for the events.
"""

import numpy as np
from matplotlib.figure import Figure

from engine.core.breath import BreathEventKind
from engine.core.frames import FloatArray
from lab.evaluation.breathing.bench import DRIFTS_MM_S, KINDS, ScoredSignal, wilson
from lab.evaluation.breathing.recorded import MonitoredTrace
from lab.evaluation.breathing.trials import MonitorOutput
from lab.evaluation.report.more_figures import COLORS, Picture, axes_of, caption, draw
from lab.evaluation.table import Cell, Table

MIN_SENSITIVITY = 0.95
MAX_CYCLES = 3.0
MAX_ALARMS_PER_10_MIN = 1.0
TEN_MINUTES_S = 600.0
EVENT_COLORS = {
    BreathEventKind.COUGH: "#b5179e",
    BreathEventKind.SIGH: "#0096c7",
    BreathEventKind.APNOEA: "#222222",
    BreathEventKind.TALKING: "#e08a00",
    BreathEventKind.IRREGULAR: "#c23b22",
    BreathEventKind.NO_CYCLE: "#7f1d1d",
    BreathEventKind.DRIFT: "#3a5fcd",
}
SECONDS_PER_ROW = 120.0


def tables_of(scored: list[ScoredSignal]) -> list[Table]:
    """Return the tables of the scores; rows that miss their target are marked as failed."""
    return [_events(scored), _drifts(scored), _regular(scored)]


def _events(scored: list[ScoredSignal]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    failed = set()
    for kind in (*KINDS, "drift"):
        found = [finding for one in scored for finding in one.findings if finding.kind == kind]
        if not found:
            continue
        delays = [finding.delay_s for finding in found if finding.delay_s is not None]
        low, high = wilson(len(delays), len(found))
        if len(delays) < MIN_SENSITIVITY * len(found):
            failed.add(len(rows))
        rows.append((kind, len(found), len(delays), len(delays) / len(found), low, high, *_spread(delays)))
    return Table(
        name="breathing_events",
        title="Labelled events: detections and delays",
        columns=(
            *("event", "labelled", "found", "sensitivity", "from", "to"),
            *("delay, median [s]", "95 % [s]", "longest [s]"),
        ),
        rows=tuple(rows),
        note=f"Mark: sensitivity of at least {MIN_SENSITIVITY:g}. From, to: 95 % interval after Wilson.",
        failed=frozenset(failed),
    )


def _drifts(scored: list[ScoredSignal]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    failed = set()
    for rate in DRIFTS_MM_S:
        for sign, way in ((1.0, "up"), (-1.0, "down")):
            found = [finding for one in scored if one.job.drift_mm_s == sign * rate for finding in one.findings]
            if not found:
                continue
            cycles = [finding.cycles for finding in found if finding.cycles is not None]
            in_time = sum(count <= MAX_CYCLES for count in cycles)
            if in_time < len(found):
                failed.add(len(rows))
            rows.append((f"{rate:g} mm/s {way}", len(found), in_time, *_spread(cycles)))
    return Table(
        name="breathing_drift",
        title="Drift: breaths until detection",
        columns=("drift", "trials", "detected in time", "cycles, median", "95 %", "most"),
        rows=tuple(rows),
        note=f"Mark: within {MAX_CYCLES:g} cycles of the patient's mean length, counted from the drift's first moment.",
        failed=frozenset(failed),
    )


def _regular(scored: list[ScoredSignal]) -> Table:
    regular = [one for one in scored if one.job.group == "regular"]
    seconds = sum(one.job.seconds for one in regular)
    alarms = [span for one in regular for span in one.false_alarms]
    rate = len(alarms) / (seconds / TEN_MINUTES_S) if regular else None
    errors = np.concatenate([np.abs(one.phase_errors) for one in regular]) if regular else np.empty(0)
    kinds = ", ".join(sorted({span.kind.value for span in alarms})) or "none"
    rows: list[tuple[Cell, ...]] = [
        ("regular breathing, hours", seconds / 3600.0),
        ("false alarms of all kinds", len(alarms)),
        ("which", kinds),
        ("false alarms in ten minutes", rate),
        ("share of the time with a phase, after 28 s", _mean([one.phase_share for one in regular])),
        ("error of the phase, mean [%]", float(errors.mean()) if errors.size else None),
        ("error of the phase, 95 % [%]", float(np.percentile(errors, 95)) if errors.size else None),
        ("error of the rate, mean [1/min]", _mean([one.rate_error_per_min for one in regular])),
    ]
    failed = {3} if rate is not None and rate > MAX_ALARMS_PER_10_MIN else set()
    return Table(
        name="breathing_regular",
        title="Regular breathing: false alarms, and errors of phase and rate",
        columns=("", "value"),
        rows=tuple(rows),
        note=f"Mark: at most {MAX_ALARMS_PER_10_MIN:g} false alarm in ten minutes. True phase: linear in time from one "
        "end of inhale to the next.",
        failed=frozenset(failed),
    )


def recorded_events(recorded: list[MonitoredTrace]) -> Table:
    """Return the monitor's events on recorded breathing, one per row."""
    rows: list[tuple[Cell, ...]] = [
        (one.name, span.kind.value, span.start_s, span.end_s, span.confidence, span.detail)
        for one in recorded
        for span in one.output.spans
    ]
    return Table(
        name="breathing_recorded",
        title="Recorded breathing: events",
        columns=("trace", "event", "from [s]", "to [s]", "confidence", "detail"),
        rows=tuple(rows),
        digits=1,
    )


def recorded_shares(recorded: list[MonitoredTrace]) -> Table:
    """Return the share with a phase and the median rate of each recorded trace."""
    rows: list[tuple[Cell, ...]] = [
        (
            one.name,
            one.seconds,
            float(np.isfinite(one.output.phase_percent).mean()),
            _median(one),
            len(one.output.spans),
        )
        for one in recorded
    ]
    return Table(
        name="breathing_traces",
        title="Recorded breathing: each trace",
        columns=("trace", "length [s]", "share with a phase", "rate, median [1/min]", "events"),
        rows=tuple(rows),
    )


def agreement(recorded: list[MonitoredTrace]) -> Table | None:
    """Return the agreement with the flags and phases of RPM exports; None without such a file."""
    rows: list[tuple[Cell, ...]] = [
        (
            one.name,
            rpm.ours,
            rpm.both,
            rpm.theirs_only,
            rpm.ours_only,
            rpm.neither,
            rpm.kappa,
            rpm.phase_error,
            rpm.phase_error_95,
        )
        for one in recorded
        for rpm in one.rpm
    ]
    if not rows:
        return None
    return Table(
        name="breathing_rpm",
        title="Agreement with the RPM's flags and phases",
        columns=(
            *("trace", "our criterion", "both irregular", "theirs only", "ours only", "neither", "kappa"),
            *("phase apart, mean [%]", "95 % [%]"),
        ),
        rows=tuple(rows),
        note="Shares of the samples after our first phase; theirs by the flag for not periodic. Phases are compared "
        "where both are regular; theirs was computed in retrospect, ours in real time. The RPM is no ground truth.",
    )


def _spread(values: "list[float]") -> tuple[Cell, Cell, Cell]:
    if not values:
        return None, None, None
    middle, high = np.percentile(values, [50.0, 95.0])
    return float(middle), float(high), float(max(values))


def _mean(values: list[float]) -> float | None:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else None


def _median(one: MonitoredTrace) -> float | None:
    rates = one.output.rate_per_min[np.isfinite(one.output.rate_per_min)]
    return float(np.median(rates)) if rates.size else None


def draw_breathing(name: str, time_s: FloatArray, value_mm: FloatArray, output: MonitorOutput) -> Picture:
    """Draw a signal [mm] with the monitor's output, two minutes per row."""
    rows = max(1, int(np.ceil(time_s[-1] / SECONDS_PER_ROW)))

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, 2 * rows)
        for row in range(rows):
            inside = (time_s >= row * SECONDS_PER_ROW) & (time_s < (row + 1) * SECONDS_PER_ROW)
            signal, phase = panels[2 * row], panels[2 * row + 1]
            signal.plot(time_s[inside], value_mm[inside], color=COLORS["truth"], linewidth=0.9)
            signal.plot(time_s[inside], output.baseline_mm[inside], color=COLORS["ours"], linewidth=1.0)
            phase.plot(time_s[inside], output.phase_percent[inside], ".", color=COLORS["ours"], markersize=1.2)
            for level, (kind, color) in enumerate(EVENT_COLORS.items()):
                on = output.during(kind, time_s) & inside
                phase.fill_between(time_s, 108 + 12 * level, 117 + 12 * level, where=on, color=color, linewidth=0)
                if row == 0:
                    phase.plot([], [], color=color, linewidth=4, label=kind.value)
            phase.set_ylim(-5, 185)
            phase.set_yticks([0, 50, 100])
            for panel in (signal, phase):
                panel.set_xlim(row * SECONDS_PER_ROW, (row + 1) * SECONDS_PER_ROW)
            caption(signal, name if row == 0 else "", y="motion and baseline [mm]")
            caption(phase, "", x="time [s]" if row == rows - 1 else "", y="phase [%]")
        panels[1].legend(fontsize=7, ncols=6, frameon=False, loc="upper left", bbox_to_anchor=(0.0, 1.25))

    note = "The signal with its baseline; below it the monitor's phase, and bars for its events."
    return draw(name, name, note, (14.0, 4.2 * rows), paint)
