"""A loop on simulated parts, armed and measuring."""

from dataclasses import replace
from functools import partial

import numpy as np

from engine.core.commands import Arm
from engine.gating.supervision.patient_shift import CORNERS, NODES
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import FRAMES_A_DWELL, LIMITS, motion_of

ARM = Arm(operator="ann", head_direction=LIMITS.head_direction)

LEARNED = 3

ON_AT = LEARNED + FRAMES_A_DWELL
"""The frame that turns the beam on: armed before frame LEARNED + 1, which begins the dwell."""


def armed_bench(more: list, **options: object) -> Bench:
    """Three frames, an arming, and then what the test wants."""
    bench = Bench([], **options)
    bench.source.script = [good] * LEARNED + [after(bench.ask(ARM)), *more]
    return bench


ON = LEARNED + 6
"""The newest frame when six were good after the arming: the beam is on."""
MARKERS_MM = np.array([[-100.0, -150.0, 850.0], [100.0, -150.0, 850.0], [100.0, 150.0, 850.0], [-100.0, 150.0, 850.0]])


def on_bench(more, **options):
    bench = armed_bench([good] * 6, **options)
    bench.source.script += more
    return bench


def lying_at(bench: Bench, first: int, x_mm: float) -> None:
    """From that frame on, the markers lie there."""

    def placed(frame, at_mm):
        surface_mm = np.zeros((NODES, 3))
        surface_mm[list(CORNERS)] = MARKERS_MM + np.array([at_mm, 0.0, 0.0])
        return replace(frame, motion=replace(motion_of(), surface_mm=surface_mm))

    for index in range(200):
        bench.pipeline.spoil[index] = partial(placed, at_mm=x_mm if index >= first else 0.0)
