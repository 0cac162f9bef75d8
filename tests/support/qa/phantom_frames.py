"""Frames of a phantom as the pipeline would have measured them, with motion and timing of the test's choosing."""

from dataclasses import replace

import numpy as np

from engine.core.frames import Lost, LostReason, MeasurementState
from engine.offline.offline_gate import TimedFrame
from lab.virtual_qa import FIRST_US, FPS
from tests.support.gating.streams import measured, motion_of

ZERO_S = 15.0
COMPUTING_NS = 2_000_000


def watched(
    given,
    *,
    error_mm=np.zeros_like,
    delay_s=0.0,
    zero_s=ZERO_S,
    phase_s=0.0,
    computing_ns=None,
    lost=(),
    jitter_s=None,
):
    """Frames of ``given``'s phantom: nothing but training before the zero, then its motion and ``error_mm`` of it."""
    first_s, last_s = given.trace.span_s
    time_s = np.arange(first_s + phase_s, last_s, 1.0 / FPS)
    if jitter_s is not None:
        time_s[1:] += jitter_s[: len(time_s) - 1]
    stamps_us = FIRST_US + np.round((time_s - time_s[0]) * 1e6).astype(int)
    place_mm = given.trace.at(np.clip(time_s - delay_s, first_s, last_s))
    zero = int(np.searchsorted(time_s, zero_s))
    motion_mm = place_mm - place_mm[zero] + error_mm(time_s)
    computing = np.full(len(time_s), COMPUTING_NS) if computing_ns is None else computing_ns[: len(time_s)]
    frames = []
    for number, (at_us, whole_mm) in enumerate(zip(stamps_us.tolist(), motion_mm.tolist(), strict=True)):
        measurement = replace(measured(number, motion_of(whole_mm)), timestamp_us=at_us)
        if number < zero:
            measurement = replace(measurement, state=MeasurementState.TRAINING, motion=None)
        elif number in lost:
            why = Lost(reason=LostReason.MARKER_LOST, detail="hidden")
            measurement = replace(measurement, state=MeasurementState.LOST, motion=None, lost=why)
        frames.append(TimedFrame(measurement=measurement, computing_ns=int(computing[number])))
    starts_us = FIRST_US - round(phase_s * 1e6)
    return replace(given, starts_us=starts_us), frames
