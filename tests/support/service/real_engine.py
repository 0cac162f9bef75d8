"""A service with the real engine on a recording, played fast."""

import time

import pytest

from engine.motion.learning.trainer import TrainingSettings
from engine.motion.settings import PipelineSettings
from service.engine_host.local_engine import LocalEngine
from tests.support.capture.hurried_source import HurriedSource
from tests.support.service.api_calls import act, audit_rows, make_session_body, upload

WIDE = {"signal": "whole", "lower_mm": -40.0, "upper_mm": 40.0, "hysteresis_mm": 0.2, "dwell_ms": 100.0}

PATIENT_LIMITS = {
    "max_frame_age_ms": 200.0,
    "lease_ms": 200.0,
    "watchdog_ms": 500.0,
    "max_gap_ms": 200.0,
    "operator_timeout_s": 0.0,
    "max_duty_percent": 100.0,
}
"""A test's machine is shared: what is tested here is the way through, not the time it takes. No page is open, and the
beam may be on during the whole breath."""
FEW_FRAMES = TrainingSettings(min_frames=50, max_frames=120, min_cycles=1, min_seconds=5.0)


class HurriedEngine(LocalEngine):
    """Plays recordings four times as fast as they were taken and learns from few frames, for a test's sake."""

    def __init__(self, settings):
        super().__init__(settings, measuring=PipelineSettings(training=FEW_FRAMES))

    def _player(self, path, _player):
        return HurriedSource(path, clock=self._clock)


def open_session(client, calibration_text, **changes):
    calibration_id = upload(client, calibration_text).json()["id"]
    body = make_session_body(calibration_id) | {"window": WIDE} | changes
    answer = client.post("/api/v1/sessions", json=body)
    assert answer.status_code == 201, answer.text
    return answer.json()["id"]


def detail_of(client, session_id):
    return client.get(f"/api/v1/sessions/{session_id}").json()


def arm_when_ready(client, session_id):
    """Set the reference and arm as soon as possible; acknowledge a busy machine's fault, as a person would."""
    answer = None
    while (detail := detail_of(client, session_id))["status"] == "running":
        if detail["gate"] is not None and detail["gate"]["state"] == "fault":
            act(client, session_id, "acknowledge")
        if detail["measurement_state"] == "measuring":
            if not detail["has_reference"]:
                act(client, session_id, "reference")
            answer = act(client, session_id, "arm")
            if answer.status_code == 200:
                return
        time.sleep(0.02)
    pytest.fail(f"the recording ended before the gate could be armed: {answer and answer.text}")


def turn_on(client, session_id):
    """Arm until the beam is on: what a busy machine faults of on the way is acknowledged, as a person would."""
    while (detail := detail_of(client, session_id))["status"] == "running":
        gate = detail["gate"]
        if gate is not None and gate["line_on"]:
            return
        if gate is not None and not gate["is_armed"]:
            arm_when_ready(client, session_id)
        time.sleep(0.02)
    reasons = [row["detail"]["reason"] for row in audit_rows(client, "gate.transition")]
    assert detail["summary"]["duty_cycle"] > 0.0, f"the recording ended before the beam was on: {reasons}"
