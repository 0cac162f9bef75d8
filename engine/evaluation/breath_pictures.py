"""Draws a signal with what was told of it: baseline, phase, and bars for the events."""

import numpy as np
from matplotlib.figure import Figure

from engine.breath import BreathEventKind
from engine.evaluation.breath_trials import Told
from engine.evaluation.canvas import COLORS, Picture, axes_of, caption, draw
from engine.frames import FloatArray

EVENT_COLORS = {
    BreathEventKind.COUGH: "#b5179e",
    BreathEventKind.SIGH: "#0096c7",
    BreathEventKind.APNOEA: "#222222",
    BreathEventKind.TALKING: "#e08a00",
    BreathEventKind.IRREGULAR: "#c23b22",
    BreathEventKind.DRIFT: "#3a5fcd",
}
SECONDS_A_ROW = 120.0


def draw_breathing(name: str, time_s: FloatArray, value_mm: FloatArray, told: Told) -> Picture:
    """Draw a signal, two minutes a row."""
    rows = max(1, int(np.ceil(time_s[-1] / SECONDS_A_ROW)))

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, 2 * rows)
        for row in range(rows):
            inside = (time_s >= row * SECONDS_A_ROW) & (time_s < (row + 1) * SECONDS_A_ROW)
            signal, phase = panels[2 * row], panels[2 * row + 1]
            signal.plot(time_s[inside], value_mm[inside], color=COLORS["truth"], linewidth=0.9)
            signal.plot(time_s[inside], told.baseline_mm[inside], color=COLORS["ours"], linewidth=1.0)
            phase.plot(time_s[inside], told.phase_percent[inside], ".", color=COLORS["ours"], markersize=1.2)
            for level, (kind, color) in enumerate(EVENT_COLORS.items()):
                on = told.during(kind, time_s) & inside
                phase.fill_between(time_s, 108 + 12 * level, 117 + 12 * level, where=on, color=color, linewidth=0)
                if row == 0:
                    phase.plot([], [], color=color, linewidth=4, label=kind.value)
            phase.set_ylim(-5, 185)
            phase.set_yticks([0, 50, 100])
            for panel in (signal, phase):
                panel.set_xlim(row * SECONDS_A_ROW, (row + 1) * SECONDS_A_ROW)
            caption(signal, name if row == 0 else "", y="motion and baseline [mm]")
            caption(phase, "", x="time [s]" if row == rows - 1 else "", y="phase [%]")
        panels[1].legend(fontsize=7, ncols=6, frameon=False, loc="upper left", bbox_to_anchor=(0.0, 1.25))

    note = "The signal with its baseline; below it the phase that was told, and bars for the events."
    return draw(name, name, note, (14.0, 4.2 * rows), paint)
