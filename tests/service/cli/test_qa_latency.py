"""``tidegate qa latency`` and ``qa cameras``: what is stored and printed, what is refused, and its exit codes."""

import json
import os
import sqlite3
import time
from contextlib import closing

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.core.errors import RecordingError, SourceLostError
from engine.verification.qa.latency.virtual import BEGINS_NS, VirtualCamera, VirtualFaults
from engine.verification.qa.trace import CommandedTrace
from service.cli import app
from service.qa.latency.rig import LatencyRig, PlateTrace
from tests.support.service.clinical_site import CLINICAL, environment
from tests.support.site_settings import give_settings

ME = ("--operator", "A. Physicist")
REAL_LINE = {"TIDEGATE_BEAM_LINE": "modbus-tcp", "TIDEGATE_BEAM_MODBUS_HOST": "127.0.0.1"}
SAFE = "--yes-the-beam-is-safe"
SECONDS = 30.0


@pytest.fixture(autouse=True)
def no_settings_around(monkeypatch):
    for name in list(os.environ):
        if name.startswith("TIDEGATE_"):
            monkeypatch.delenv(name)


@pytest.fixture
def data(tmp_path):
    return tmp_path / "data"


@pytest.fixture
def run(data):
    return lambda *words: CliRunner().invoke(app, ["qa", *map(str, words), "--data", str(data)])


@pytest.fixture
def real_line(monkeypatch):
    for name, value in REAL_LINE.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def plate(monkeypatch, tmp_path):
    """A camera that sees a plate move, and the file of its controller by this machine's monotonic clock."""
    time_s = np.arange(-1.0, SECONDS + 2.0, 0.02)
    position_mm = 6.0 * np.sin(2 * np.pi * 0.23 * time_s) + 3.0 * np.sin(2 * np.pi * 0.61 * time_s + 1.0)
    trace = CommandedTrace(time_s=time_s, position_mm=position_mm)
    camera = VirtualCamera(VirtualFaults(delay_ms=60.0), seed=1, seconds=SECONDS, plate=trace)
    monkeypatch.setattr(LatencyRig, "camera", lambda _rig, _uri: camera)
    rows = (f"{at + BEGINS_NS / 1e9:.6f},{mm:.6f}" for at, mm in zip(time_s, position_mm, strict=True))
    path = tmp_path / "plate.csv"
    path.write_text("\n".join(["monotonic_s,position_mm", *rows]))
    return path


def query(data, text):
    with closing(sqlite3.connect(data / "tidegate.db")) as raw:
        return raw.execute(text).fetchall()


def by_plate(run, path, *words):
    return run("latency", *ME, "--method", "plate", "--trace", path, "--seconds", SECONDS, *words)


@pytest.mark.parametrize("method", ["light", "plate"])
def test_a_simulated_run_finds_its_delay_and_counts_for_nothing(run, data, method, tmp_path):
    out = tmp_path / "report.pdf"
    words = ("--method", method, "--seconds", SECONDS, "--fault-delay-ms", 55, "--out", out)
    done = run("latency", *ME, "--simulated", *words)
    assert done.exit_code == 0, done.stderr
    assert "SIMULATED: not a QA result" in done.stdout
    assert out.read_bytes().startswith(b"%PDF")
    values = dict(query(data, "SELECT code, value FROM qa_results"))
    half_ms = values["camera_latency_uncertainty_ms"]
    assert 55.0 - half_ms <= values["camera_latency_ms"] <= 57.0 + half_ms
    listed = run("cameras").stdout
    assert "The site counts 0 ms; longest age 365 days." in listed
    assert "VIRTUAL" not in listed
    assert "latency (simulated)" in run("list").stdout


def test_a_run_stores_camera_mode_person_and_method_in_database_and_audit(run, data, plate):
    done = by_plate(run, plate, "--clock-error-ms", 2, "--note", "table B")
    assert done.exit_code == 0, done.stderr
    ((operator, kind, request, is_simulated),) = query(
        data, "SELECT operator, kind, request, is_simulated FROM qa_runs"
    )
    assert (operator, kind, is_simulated) == ("A. Physicist", "latency", 0)
    kept = json.loads(request)
    assert kept["camera"] == {
        "name": "virtual camera",
        "serial": "VIRTUAL",
        "depth_size": [80, 60],
        "color_size": [80, 60],
        "fps": 30.0,
    }
    assert (kept["method"], kept["clock_error_ms"], kept["note"]) == ("plate", 2.0, "table B")
    actions = dict(query(data, "SELECT action, detail FROM audit WHERE action LIKE 'qa.%'"))
    assert json.loads(actions["qa.start"])["request"]["camera"]["serial"] == "VIRTUAL"
    assert json.loads(actions["qa.end"])["verdict"] == "pass"
    ((value, detail),) = query(data, "SELECT value, detail FROM qa_results WHERE code = 'camera_latency_ms'")
    assert value == pytest.approx(60.7, abs=3.0)
    assert "trace with SHA-256" in detail
    cameras = run("cameras").stdout
    assert "VIRTUAL" in cameras
    assert "A. Physicist" in cameras
    assert "Clinical mode refuses to arm: the latency of camera VIRTUAL" in cameras
    assert "set TIDEGATE_CAMERA_LATENCY_MS to" in cameras
    assert "Camera latency, median [ms]" in run("trend", "camera_latency_ms").stdout


def test_a_trace_of_another_time_fails_the_run_and_measures_nothing(run, data, plate):
    rows = plate.read_text().splitlines()
    later = [rows[0], *(f"{float(row.split(',')[0]) + 500.0},{row.split(',')[1]}" for row in rows[1:])]
    plate.write_text("\n".join(later))
    done = by_plate(run, plate, "--clock-error-ms", 2)
    assert done.exit_code == 1
    assert "do its times belong to this run" in done.stdout
    assert query(data, "SELECT value FROM qa_results") == [(None,)] * 4
    assert "VIRTUAL" not in run("cameras").stdout


def test_a_missing_trace_fails_the_run(run, plate, tmp_path):
    done = by_plate(run, tmp_path / "none.csv", "--clock-error-ms", 2)
    assert done.exit_code == 1
    assert "none.csv: cannot be read" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--method", "light", "--output-delay-ms", 5), "--method must be plate: a simulated beam line"),
        (("--method", "plate", "--clock-error-ms", 2), "--trace must be given"),
        (("--method", "plate", "--trace", "x.csv"), "clock_error_ms"),
        (("--method", "plate", "--trace", "x.csv", "--clock-error-ms", 25), "clock_error_ms"),
        (("--method", "plate", "--trace", "x.csv", "--clock-error-ms", 1, "--output-delay-ms", 1), "output_delay_ms"),
        (("--simulated", "--fault-delay-ms", 501), "--fault-delay-ms must be 0 to 500"),
        (("--simulated", "--seconds", 29), "--seconds must be 30 to 120"),
        (("--method", "plate", "--trace", "x.csv", "--clock-error-ms", 1, "--seconds", 121), "seconds"),
    ],
    ids=str,
)
def test_what_cannot_be_measured_is_refused_with_the_bound_and_nothing_is_stored(run, data, plate, words, says):
    done = run("latency", *ME, *words)
    assert done.exit_code == 2, done.stdout
    assert says in done.stderr
    assert query(data, "SELECT * FROM qa_runs") == []


def test_a_real_line_needs_the_word_that_the_beam_is_safe(run, data, plate, real_line):
    refused = run("latency", *ME, "--output-delay-ms", 5)
    assert refused.exit_code == 2
    assert "--yes-the-beam-is-safe must be given" in refused.stderr
    assert query(data, "SELECT * FROM qa_runs") == []


def test_the_output_s_delay_has_no_default(run, plate, real_line):
    refused = run("latency", *ME, SAFE)
    assert refused.exit_code == 2
    assert "output_delay_ms" in refused.stderr


def test_nothing_is_measured_while_a_session_is_created(run, data, plate, monkeypatch):
    run("latency", *ME, "--simulated", "--seconds", SECONDS)
    monkeypatch.setattr("service.qa.runs.queries.open_session_id", lambda _db: "c" * 32)
    refused = by_plate(run, plate, "--clock-error-ms", 2)
    assert refused.exit_code == 2
    assert "a session is created or running" in refused.stderr
    assert len(query(data, "SELECT * FROM qa_runs")) == 1


def test_clinical_mode_permits_no_simulation(run, monkeypatch, tmp_path):
    give_settings(monkeypatch, tmp_path, **environment(CLINICAL))
    refused = run("latency", *ME, "--simulated")
    assert refused.exit_code == 2
    assert "clinical mode permits no simulation" in refused.stderr


def test_without_a_camera_it_is_refused(run, monkeypatch, real_line):
    def none(_rig, _uri):
        raise SourceLostError("the OpenNI2 runtime sees no such camera")

    monkeypatch.setattr(LatencyRig, "camera", none)
    refused = run("latency", *ME, "--output-delay-ms", 5, SAFE)
    assert refused.exit_code == 2
    assert "sees no such camera" in refused.stderr


@pytest.mark.parametrize("step_s", [0.0, 0.002])
def test_a_wall_clock_that_was_set_during_the_measurement_refuses_the_trace(tmp_path, monkeypatch, step_s):
    path = tmp_path / "plate.csv"
    path.write_text("\n".join(["monotonic_s,position_mm", *(f"{n / 10},{n}" for n in range(20))]))
    trace = PlateTrace(path, lambda _path: None)
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + round(step_s * 1e9))
    if step_s == 0.0:
        assert trace.read().trace.reach_mm == (0.0, 19.0)
    else:
        with pytest.raises(RecordingError, match="clock was set by 2"):
            trace.read()
