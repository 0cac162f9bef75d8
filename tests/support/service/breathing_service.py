"""A service process on an engine that breathes, learns in a second and gates by its window.

Over HTTP it is the real service; only the engine behind the ports is fast. As a command:
``python -m tests.support.service.breathing_service DATA RECORDINGS PORT [--fault-at FRAME]``, which faults once.
"""

import argparse
import contextlib
import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.capture.source import SourceDescription
from engine.control.outputs import FrameRecord, GateTransition, LatencySummary, LiveView
from engine.control.turn_inputs import Command
from engine.core.commands import Acknowledge, Disarm
from engine.core.frames import MeasurementState, TrainingProgress
from engine.core.gate_state import GateState, HoldReason
from service.core.settings.settings import Settings
from service.web.app import create_app
from service.web.server import make_server
from tests.support.service.fake_engine import FakeEngine, FakeRunning, make_measurement

FRAME_S = 1 / 30
LEARNED_AT = 20
BREATH_S = 2.0
ARMED = frozenset({GateState.HOLD, GateState.DWELL, GateState.BEAM_ON})


class BreathingRun(FakeRunning):
    """One session of it: frames of a breath, and a gate that is on inside the window while no one holds."""

    def __init__(self, plan, *, fault_at: int | None) -> None:
        super().__init__(plan, sample_capacity=20_000)
        self.lock = threading.RLock()
        self.fault_at = fault_at
        self.reason = HoldReason.DISARMED
        self.number = 0

    def submit(self, command: Command, *, submitted_ns: int | None = None):
        with self.lock:
            return super().submit(command, submitted_ns=submitted_ns)

    def _obey(self, command: Command) -> None:
        super()._obey(command)
        if isinstance(command, Disarm | Acknowledge):
            self.operator_hold = None

    def stop(self) -> None:
        with self.lock:
            super().stop()

    def transition(self, to_state, reason=None, *, operator=None) -> GateTransition:
        now_ns = time.monotonic_ns()
        made = GateTransition(
            at_ns=now_ns,
            frame_index=self.number,
            from_state=self.gate,
            to_state=to_state,
            reason=reason,
            operator=operator,
            detail="",
            captured_us=self.number * 33_333,
            received_ns=now_ns,
            decided_ns=now_ns,
            asserted_ns=now_ns,
        )
        self.gate = to_state
        self.reason = reason or HoldReason.DISARMED
        self.transitions.put_nowait(made)
        return made

    def decide(self, whole_mm: float) -> None:
        if self.fault_at is not None and self.number >= self.fault_at and self.gate in ARMED:
            self.fault_at = None
            self.transition(GateState.FAULT, HoldReason.FRAME_STALE)
        if self.gate not in ARMED:
            return
        window = self.plan.window
        is_inside = self.operator_hold is None and window.lower_mm <= whole_mm <= window.upper_mm
        wanted = GateState.BEAM_ON if is_inside else GateState.HOLD
        why = HoldReason.OPERATOR_HOLD if self.operator_hold else HoldReason.OUTSIDE_WINDOW
        if wanted is not self.gate:
            self.transition(wanted, None if is_inside else why)
        elif not is_inside:
            self.reason = why

    def step(self) -> None:
        whole_mm = 1.0 - 3.0 * math.cos(2 * math.pi * self.number * FRAME_S / BREATH_S)
        is_learning = self.number < LEARNED_AT
        if not is_learning:
            self.decide(whole_mm)
        now_ns = time.monotonic_ns()
        measurement = make_measurement(self.number, whole_mm=whole_mm, received_ns=now_ns)
        measurement = replace(measurement, timestamp_us=self.number * 33_333)
        if is_learning:
            share = self.number / LEARNED_AT
            progress = TrainingProgress(frames=self.number, cycles=1, seconds=1.0, share=share)
            measurement = replace(measurement, state=MeasurementState.TRAINING, motion=None, training=progress)
        is_on = self.gate is GateState.BEAM_ON
        record = FrameRecord(
            measurement=measurement,
            gate_state=self.gate,
            hold_reason=None if is_on else self.reason,
            signal_mm=None if is_learning else whole_mm,
            received_ns=now_ns,
            decided_ns=now_ns,
            asserted_ns=now_ns,
            line_on=is_on,
            captured_ns=None,
        )
        self.samples.put_nowait(record)
        self.latest = self._view(record)
        self.number += 1

    def _view(self, record: FrameRecord) -> LiveView:
        return LiveView(
            record=record,
            color=np.zeros((48, 64, 3), dtype=np.uint8),
            frames=self.number + 1,
            missed_frames=0,
            dropped_records=0,
            fps=30.0,
            latency=LatencySummary(last_ms=1.0, p50_ms=1.0, p99_ms=1.0, max_ms=1.0),
            is_armed=self.gate in ARMED,
            detail="",
            description=SourceDescription(
                kind="fake", name="fake", depth_size=(640, 480), color_size=(640, 480), fps=30.0, is_live=False
            ),
            status=self.status,
            error=None,
            window=self.window,
            operator_holds=() if self.operator_hold is None else (self.operator_hold,),
        )


class BreathingEngine(FakeEngine):
    """Thirty frames a second of every session."""

    def __init__(self, fault_at: int | None) -> None:
        super().__init__()
        self._fault_at = fault_at

    def open(self, plan):
        running = BreathingRun(plan, fault_at=self._fault_at)
        self.opened.append(running)
        threading.Thread(target=_drive, args=(running,), daemon=True).start()
        return running


def _drive(running: BreathingRun) -> None:
    due_s = time.monotonic()
    while True:
        with running.lock:
            if running.status.is_over:
                return
            running.step()
        due_s += FRAME_S
        time.sleep(max(0.0, due_s - time.monotonic()))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("port", type=int)
    parser.add_argument("--fault-at", type=int)
    asked = parser.parse_args()
    settings = Settings(data_dir=asked.data, recordings_dirs=(asked.recordings,), port=asked.port)
    with contextlib.suppress(KeyboardInterrupt):
        app = create_app(settings, lambda _settings: BreathingEngine(asked.fault_at))
        make_server(app, host=settings.host, port=settings.port).run()


if __name__ == "__main__":
    main()
