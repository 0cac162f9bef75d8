"""Why the beam is held, in the words of the treatment room; the codes are in `engine.permits`."""

from engine.permits import HoldReason

HOLD_TEXTS: dict[HoldReason, str] = {
    HoldReason.DISARMED: "Not armed",
    HoldReason.OUTSIDE_WINDOW: "Outside the window",
    HoldReason.DWELL: "Inside the window, waiting out the dwell time",
    HoldReason.TRAINING: "Learning how the patient breathes",
    HoldReason.MODEL_MISSING: "No motion model yet",
    HoldReason.REFERENCE_MISSING: "No reference position yet",
    HoldReason.MARKER_LOST: "A marker cannot be seen",
    HoldReason.LAYOUT_CHANGED: "The markers moved against each other",
    HoldReason.COVERAGE_LOW: "Too little of the region can be seen",
    HoldReason.RESIDUAL_HIGH: "The surface does not match what was learned",
    HoldReason.JUMP: "The signal jumped",
    HoldReason.FRAME_MISSING: "A camera frame is missing",
    HoldReason.FRAME_LATE: "Camera frames come late",
    HoldReason.OPERATOR_HOLD: "Held by an operator",
    HoldReason.OPERATOR_LOST: "The page of the person who armed is silent",
    HoldReason.FRAME_FROZEN: "The camera shows the same picture again",
    HoldReason.FRAME_RATE_LOW: "The camera is too slow",
    HoldReason.PATIENT_SHIFTED: "The patient has moved on the couch",
    HoldReason.MODEL_OLD: "The motion model is too old: learn again",
    HoldReason.CALIBRATION_MISSING: "This camera was never calibrated",
    HoldReason.BREATHING_IRREGULAR: "The breathing is not regular",
    HoldReason.PHASE_UNKNOWN: "The phase of the breath cannot be told",
    HoldReason.RANGE_UNKNOWN: "The patient's range of breathing is not known yet",
    HoldReason.BREATH_HOLD_AWAITED: "Waiting for the breath hold",
    HoldReason.BREATH_HOLD_SETTLING: "Breath held, waiting until it is still",
    HoldReason.BREATH_HOLD_DRIFTED: "The breath hold has drifted: breathe, then hold again",
    HoldReason.BREATH_HOLD_OVER: "The breath hold's time is over: breathe",
    HoldReason.SHORTEST_OFF: "Waiting out the shortest time off",
    HoldReason.CYCLE_LIMIT: "The beam was switched as often as it may be in a minute",
    HoldReason.FRAME_STALE: "The newest camera frame is too old",
    HoldReason.FRAME_TIMEOUT: "The camera went silent, or shows nothing new",
    HoldReason.CLOCK_BACKWARDS: "The camera's clock went back",
    HoldReason.CLOCK_JUMPED: "The camera's clock jumped",
    HoldReason.LATENCY_HIGH: "From camera to beam line it took too long",
    HoldReason.VALUE_INVALID: "A measured value is no number",
    HoldReason.SOURCE_LOST: "The camera is gone",
    HoldReason.BEAM_LINE_FAILED: "The beam line does not answer",
    HoldReason.BEAM_LINE_MISMATCH: "The beam line does not do what it is told",
    HoldReason.AUDIT_BEHIND: "The audit log cannot keep up",
    HoldReason.RECORDER_BEHIND: "The recording cannot keep up",
    HoldReason.DISK_LOW: "The disk is almost full",
    HoldReason.SERVICE_SILENT: "The service does not answer",
    HoldReason.WATCHDOG: "No decision came in time",
    HoldReason.ENGINE_FAILED: "The engine failed",
    HoldReason.SOURCE_ENDED: "The recording is over",
    HoldReason.ENGINE_STOPPED: "Shutting down",
    HoldReason.UNKNOWN: "Held for an unknown reason",
}


def hold_text(reason: HoldReason | None) -> str | None:
    """Put a reason in words; an unknown one shows its code, never nothing."""
    return None if reason is None else HOLD_TEXTS.get(reason, f"Held: {reason.value}")
