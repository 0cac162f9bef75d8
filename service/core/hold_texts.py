"""One sentence for each hold reason, as the page shows it; the codes are in `engine.core.gate_state`."""

from engine.core.gate_state import HoldReason

HOLD_TEXTS: dict[HoldReason, str] = {
    HoldReason.DISARMED: "Not armed",
    HoldReason.OUTSIDE_WINDOW: "Outside the window",
    HoldReason.DWELL: "Inside the window, dwell time is running",
    HoldReason.TRAINING: "Training the motion model",
    HoldReason.MODEL_MISSING: "No motion model yet",
    HoldReason.REFERENCE_MISSING: "No reference yet: set the reference",
    HoldReason.MARKER_LOST: "A marker is not visible",
    HoldReason.LAYOUT_CHANGED: "The markers have moved relative to each other",
    HoldReason.COVERAGE_LOW: "Too little of the region or of the gated signal is visible",
    HoldReason.RESIDUAL_HIGH: "The surface does not match the motion model",
    HoldReason.JUMP: "The signal jumped",
    HoldReason.FRAME_MISSING: "A camera frame is missing",
    HoldReason.FRAME_LATE: "Camera frames arrive late",
    HoldReason.OPERATOR_HOLD: "Held by an operator",
    HoldReason.OPERATOR_LOST: "The page of the operator who armed does not respond",
    HoldReason.FRAME_FROZEN: "The camera repeats the same picture",
    HoldReason.FRAME_RATE_LOW: "The camera's frame rate is too low",
    HoldReason.PATIENT_SHIFTED: "The patient has moved on the couch",
    HoldReason.MODEL_OLD: "The motion model is too old: train again",
    HoldReason.CALIBRATION_MISSING: "This camera is not calibrated",
    HoldReason.HEAD_DIRECTION_MISSING: "The direction of the patient's head is not known",
    HoldReason.BREATHING_IRREGULAR: "The breathing is irregular",
    HoldReason.PHASE_UNKNOWN: "The breathing phase is unknown",
    HoldReason.RANGE_UNKNOWN: "The patient's breathing range is not known yet",
    HoldReason.BREATH_HOLD_AWAITED: "Waiting for the breath hold",
    HoldReason.BREATH_HOLD_SETTLING: "Breath held, waiting until it is stable",
    HoldReason.BREATH_HOLD_DRIFTED: "The breath hold has drifted: breathe, then hold again",
    HoldReason.BREATH_HOLD_OVER: "The breath hold has reached its time limit: breathe",
    HoldReason.SHORTEST_OFF: "Minimum beam-off time is running",
    HoldReason.CYCLE_LIMIT: "The limit of beam cycles per minute is reached",
    HoldReason.FRAME_STALE: "The newest camera frame is too old",
    HoldReason.FRAME_TIMEOUT: "No new frame from the camera",
    HoldReason.CLOCK_BACKWARDS: "The camera's clock went backwards",
    HoldReason.CLOCK_JUMPED: "The camera's clock jumped",
    HoldReason.LATENCY_HIGH: "The latency from camera to beam line is too high",
    HoldReason.VALUE_INVALID: "A measured value is not a number",
    HoldReason.SOURCE_LOST: "The camera is disconnected",
    HoldReason.BEAM_LINE_FAILED: "The beam line does not answer",
    HoldReason.BEAM_LINE_MISMATCH: "The beam line's read-back differs from the command",
    HoldReason.AUDIT_BEHIND: "The audit log cannot keep up",
    HoldReason.RECORDER_BEHIND: "The sample recorder cannot keep up",
    HoldReason.DISK_LOW: "The disk is almost full",
    HoldReason.SERVICE_SILENT: "The service does not answer",
    HoldReason.WATCHDOG: "The engine did not decide in time",
    HoldReason.ENGINE_FAILED: "The engine failed",
    HoldReason.SOURCE_ENDED: "The recording has ended",
    HoldReason.ENGINE_STOPPED: "Shutting down",
    HoldReason.UNKNOWN: "Held for an unknown reason",
}


def hold_text(reason: HoldReason | None) -> str | None:
    """Return the sentence of a reason; None for None, the code for a reason without a sentence."""
    return None if reason is None else HOLD_TEXTS.get(reason, f"Held: {reason.value}")
