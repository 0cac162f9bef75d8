"""``tidegate qa latency`` end to end: the real runtime's live camera, a light on the contact of a Modbus receiver."""

import contextlib
import json
import os
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.support.beam.receivers import REGISTERS, receiver
from tests.support.repository import ROOT
from tests.support.site_settings import with_config
from tests.support.virtual_camera.block import Kind, Streams

pytestmark = pytest.mark.alone

LIGHT_RECT = (500, 60, 24, 24)
SECONDS = 30.0
"""Changes of the light come 0.3 s apart on average, and 40 are needed in each direction."""
PATIENCE_S = 150.0
TRIES = 3


class LightOnContact:
    """A light in the camera's colour picture that follows the contact of a receiver."""

    def __init__(self, camera, far, *, is_in_view=True, late_ms=0.0):
        self._camera, self._far, self._is_in_view, self._late_ms = camera, far, is_in_view, late_ms
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_failure):
        self._is_over.set()
        self._thread.join(5.0)

    def _follow(self):
        lit = None
        if self._late_ms:  # from the first frame on: the camera is opened once before the run, to describe it
            while not self._camera.status.is_open and not self._is_over.wait(0.001):
                pass
            self._camera.order(Kind.LATE, x=(self._late_ms, 0.0))
        while not self._is_over.wait(0.001):
            if self._far.is_on is (lit is not None) or not self._is_in_view:
                continue
            if lit is None:
                lit = self._camera.order(Kind.FILL, n=(*LIGHT_RECT, -1, 0xFFFFFF), streams=Streams.COLOR)
            else:
                self._camera.order(Kind.UNDO, n=(lit,), streams=Streams.COLOR)
                lit = None


def measured(camera, data: Path, far, *arguments) -> subprocess.CompletedProcess:
    line = {"LINE": "modbus-tcp", "MODBUS_HOST": "127.0.0.1", "MODBUS_PORT": far.where, "MODBUS_UNIT": REGISTERS.unit}
    places = {
        "MODBUS_PERMIT_COIL": REGISTERS.permit_coil,
        "MODBUS_HEARTBEAT_REGISTER": REGISTERS.heartbeat_register,
        "MODBUS_READBACK_INPUT": REGISTERS.readback_input,
        "ANSWER_MS": 150,
        "SETTLE_MS": 10,
    }
    site = {f"TIDEGATE_BEAM_{name}": str(value) for name, value in (line | places).items()}
    kept = {name: value for name, value in os.environ.items() if not name.startswith("TIDEGATE_")}
    asked = ("qa", "latency", "--operator", "A. Physicist", "--seconds", SECONDS, "--data", data, *arguments)
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *map(str, asked)],
        env=kept | camera.environment | with_config(site, data.parent / "config"),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )


def results(data: Path) -> dict[str, tuple[float | None, str]]:
    with contextlib.closing(sqlite3.connect(data / "tidegate.db")) as raw:
        query = "SELECT code, value, detail FROM qa_results JOIN qa_runs ON qa_runs.id = run_id ORDER BY created_at"
        return {code: (value, text) for code, value, text in raw.execute(query)}


LIGHT = ("--output-delay-ms", 5, "--yes-the-beam-is-safe")


def test_a_light_on_the_line_measures_the_camera_through_the_runtime(camera, tmp_path):
    late_ms = 60.0
    for _ in range(TRIES):
        with receiver("tcp") as far, LightOnContact(camera, far, late_ms=late_ms):
            measured(camera, tmp_path, far, *LIGHT)
            assert far.seen[-1][0] == "off"
        found = results(tmp_path)
        median_ms, detail = found["camera_latency_ms"]
        if "could not be driven" not in detail:  # a line whose answers a busy machine delayed
            break
    half_ms, _ = found["camera_latency_uncertainty_ms"]
    assert median_ms is not None, detail
    assert half_ms < 25.0
    assert late_ms - half_ms <= median_ms <= late_ms + half_ms + 15.0
    with contextlib.closing(sqlite3.connect(tmp_path / "tidegate.db")) as raw:
        request = json.loads(raw.execute("SELECT request FROM qa_runs").fetchone()[0])
    assert request["camera"]["depth_size"] == [640, 480]
    assert request["camera"]["serial"]


def test_a_light_out_of_view_gives_no_number(camera, tmp_path):
    with receiver("tcp") as far, LightOnContact(camera, far, is_in_view=False):
        done = measured(camera, tmp_path, far, *LIGHT)
        assert any(edge[0] == "on" for edge in far.seen)
    assert done.returncode == 1
    value, detail = results(tmp_path)["camera_latency_ms"]
    assert value is None
    assert "not in view" in detail
