"""Draws a signal with the monitor's output: baseline, phase, and bars for the events."""

import numpy as np
from matplotlib.figure import Figure

from engine.core.breath import BreathEventKind
from engine.core.frames import FloatArray
from engine.lab.evaluation.breathing.trials import MonitorOutput
from engine.lab.evaluation.report.canvas import COLORS, Picture, axes_of, caption, draw

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
