"""Every way a frame can be bad, as a function that spoils a good one; one list for the holds, one for the faults."""

import math
from collections.abc import Callable
from dataclasses import replace

from engine.core.frames import LostReason, Measurement, MeasurementState
from engine.core.gate_state import HoldReason
from tests.support.gating.streams import LEVEL_MM, MS, motion_of, unmeasured

Spoil = Callable[[Measurement], Measurement]


def _with_motion(**changes: object) -> Spoil:
    return lambda frame: replace(frame, motion=motion_of(**changes))


def _lost(reason: LostReason) -> Spoil:
    return lambda frame: unmeasured(frame, MeasurementState.LOST, reason)


HOLDS: dict[str, tuple[Spoil, HoldReason]] = {
    "above the window": (_with_motion(whole_mm=3.01), HoldReason.OUTSIDE_WINDOW),
    "training": (lambda frame: unmeasured(frame, MeasurementState.TRAINING), HoldReason.TRAINING),
    "marker lost": (_lost(LostReason.MARKER_LOST), HoldReason.MARKER_LOST),
    "layout changed": (_lost(LostReason.LAYOUT_CHANGED), HoldReason.LAYOUT_CHANGED),
    "lost for coverage": (_lost(LostReason.COVERAGE_LOW), HoldReason.COVERAGE_LOW),
    "lost for residual": (_lost(LostReason.RESIDUAL_HIGH), HoldReason.RESIDUAL_HIGH),
    "lost for another surface": (_lost(LostReason.SURFACE_CHANGED), HoldReason.SURFACE_CHANGED),
    "lost for a camera that moved": (_lost(LostReason.CAMERA_MOVED), HoldReason.CAMERA_MOVED),
    "residual too high": (_with_motion(residual_mm=3.001), HoldReason.RESIDUAL_HIGH),
    "too few pixels": (_with_motion(valid_share=0.799), HoldReason.COVERAGE_LOW),
    "too few pixels that fit": (_with_motion(inlier_share=0.599), HoldReason.RESIDUAL_HIGH),
    "a frame lost by the device": (lambda frame: replace(frame, missed_frames=1), HoldReason.FRAME_MISSING),
    "a frame lost on the way": (
        lambda frame: replace(frame, frame_index=frame.frame_index + 1),
        HoldReason.FRAME_MISSING,
    ),
    "a gap in device time": (
        lambda frame: replace(frame, timestamp_us=frame.timestamp_us + 27_000),
        HoldReason.FRAME_MISSING,
    ),
    "a gap in host time": (
        lambda frame: replace(frame, received_ns=frame.received_ns + 27 * MS),
        HoldReason.FRAME_MISSING,
    ),
}

FAULTS: dict[str, tuple[Spoil, HoldReason]] = {
    "whole is NaN": (_with_motion(whole_mm=math.nan), HoldReason.VALUE_INVALID),
    "whole is infinite": (_with_motion(whole_mm=math.inf), HoldReason.VALUE_INVALID),
    "whole is minus infinity": (_with_motion(whole_mm=-math.inf), HoldReason.VALUE_INVALID),
    "thorax is NaN": (_with_motion(whole_mm=LEVEL_MM, thorax_mm=math.nan), HoldReason.VALUE_INVALID),
    "abdomen is NaN": (_with_motion(whole_mm=LEVEL_MM, abdomen_mm=math.nan), HoldReason.VALUE_INVALID),
    "residual is NaN": (_with_motion(residual_mm=math.nan), HoldReason.VALUE_INVALID),
    "residual is negative": (_with_motion(residual_mm=-0.1), HoldReason.VALUE_INVALID),
    "valid share is NaN": (_with_motion(valid_share=math.nan), HoldReason.VALUE_INVALID),
    "valid share is over one": (_with_motion(valid_share=1.01), HoldReason.VALUE_INVALID),
    "a coefficient is NaN": (_with_motion(beta=(1.0, math.nan, 0.0)), HoldReason.VALUE_INVALID),
    "a coefficient is infinite": (_with_motion(beta=(1.0, math.inf, 0.0)), HoldReason.VALUE_INVALID),
    "a correction is NaN": (_with_motion(coefficients=(1.0, 0.0, 0.0, math.nan)), HoldReason.VALUE_INVALID),
    "inlier share is NaN": (_with_motion(inlier_share=math.nan), HoldReason.VALUE_INVALID),
    "inlier share is over one": (_with_motion(inlier_share=1.01), HoldReason.VALUE_INVALID),
    "lost for a bad value": (_lost(LostReason.VALUE_INVALID), HoldReason.VALUE_INVALID),
    "lost for nothing known": (lambda frame: unmeasured(frame, MeasurementState.LOST), HoldReason.VALUE_INVALID),
    "measuring without motion": (lambda frame: replace(frame, motion=None), HoldReason.VALUE_INVALID),
    "fewer than no frames missed": (lambda frame: replace(frame, missed_frames=-1), HoldReason.VALUE_INVALID),
    "device clock stands still": (
        lambda frame: replace(frame, timestamp_us=frame.timestamp_us - 33_367),
        HoldReason.CLOCK_BACKWARDS,
    ),
    "device clock goes back": (
        lambda frame: replace(frame, timestamp_us=frame.timestamp_us - 900_000),
        HoldReason.CLOCK_BACKWARDS,
    ),
    "the same frame twice": (
        lambda frame: replace(frame, frame_index=frame.frame_index - 1),
        HoldReason.CLOCK_BACKWARDS,
    ),
    "device clock jumps ahead": (
        lambda frame: replace(frame, timestamp_us=frame.timestamp_us + 251_000),
        HoldReason.CLOCK_JUMPED,
    ),
    "received before the last frame": (
        lambda frame: replace(frame, received_ns=frame.received_ns - 34 * MS),
        HoldReason.CLOCK_BACKWARDS,
    ),
    "received together with the last frame": (
        lambda frame: replace(frame, received_ns=frame.received_ns - 33_367_000),
        HoldReason.CLOCK_BACKWARDS,
    ),
}
