"""``tidegate qa latency`` and ``qa cameras``: what is stored and printed, what is refused, and its exit codes."""

import json
import sqlite3
from contextlib import closing

import pytest
from typer.testing import CliRunner

from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import MonotonicClock
from engine.core.errors import SourceLostError
from lab.virtual_latency import VirtualFaults, virtual_light
from service.cli import app
from service.qa.guarded_line import GuardedLine
from service.qa.latency.rig import LatencyJob, LatencyRig
from tests.support.service.clinical_site import CLINICAL, environment
from tests.support.site_settings import give_settings

pytestmark = pytest.mark.usefixtures("no_settings_around")

ME = ("--operator", "A. Physicist")
REAL_LINE = {"TIDEGATE_BEAM_LINE": "modbus-tcp", "TIDEGATE_BEAM_MODBUS_HOST": "127.0.0.1"}
SAFE = "--yes-the-beam-is-safe"
SECONDS = 30.0


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
def light(monkeypatch, real_line):
    """A camera that sees a light, and a site whose line switches it; both are virtual."""
    given = virtual_light(VirtualFaults(delay_ms=60.0), seed=1, seconds=SECONDS)
    job = LatencyJob(given, GuardedLine(SimulatedBeamLine(MonotonicClock())))
    monkeypatch.setattr(LatencyRig, "camera", lambda _rig, _uri: given.source)
    monkeypatch.setattr(LatencyRig, "light_job", lambda *_: job)


def query(data, text):
    with closing(sqlite3.connect(data / "tidegate.db")) as raw:
        return raw.execute(text).fetchall()


def by_light(run, *words):
    return run("latency", *ME, SAFE, "--output-delay-ms", 5, "--seconds", SECONDS, *words)


def test_a_simulated_run_finds_its_delay_and_counts_for_nothing(run, data, tmp_path):
    out = tmp_path / "report.pdf"
    words = ("--seconds", SECONDS, "--fault-delay-ms", 55, "--out", out)
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


def test_a_run_stores_camera_mode_and_person_in_database_and_audit(run, data, light):
    done = by_light(run, "--note", "table B")
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
    assert (kept["output_delay_ms"], kept["note"]) == (5.0, "table B")
    actions = dict(query(data, "SELECT action, detail FROM audit WHERE action LIKE 'qa.%'"))
    assert json.loads(actions["qa.start"])["request"]["camera"]["serial"] == "VIRTUAL"
    assert json.loads(actions["qa.end"])["verdict"] == "pass"
    ((value, detail),) = query(data, "SELECT value, detail FROM qa_results WHERE code = 'camera_latency_ms'")
    assert value == pytest.approx(60.7, abs=6.0)
    assert "changes" in detail
    cameras = run("cameras").stdout
    assert "VIRTUAL" in cameras
    assert "A. Physicist" in cameras
    assert "Clinical mode refuses to arm: the latency of camera VIRTUAL" in cameras
    assert "set TIDEGATE_CAMERA_LATENCY_MS to" in cameras
    assert "Camera latency, median [ms]" in run("trend", "camera_latency_ms").stdout


def test_a_run_without_a_number_measures_nothing(run, data, light, monkeypatch):
    out_of_view = virtual_light(VirtualFaults(light_step=0.0), seed=1, seconds=SECONDS)
    job = LatencyJob(out_of_view, GuardedLine(SimulatedBeamLine(MonotonicClock())))
    monkeypatch.setattr(LatencyRig, "light_job", lambda *_: job)
    done = by_light(run)
    assert done.exit_code == 1
    assert "not in view" in done.stdout
    assert query(data, "SELECT value FROM qa_results") == [(None,)] * 4
    assert "VIRTUAL" not in run("cameras").stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((SAFE,), "output_delay_ms"),
        ((SAFE, "--output-delay-ms", 51), "output_delay_ms"),
        (("--simulated", "--fault-delay-ms", 501), "--fault-delay-ms must be 0 to 500"),
        (("--simulated", "--seconds", 29), "--seconds must be 30 to 120"),
        ((SAFE, "--output-delay-ms", 5, "--seconds", 121), "seconds"),
        (("--output-delay-ms", 5), "--yes-the-beam-is-safe must be given"),
    ],
    ids=str,
)
def test_what_cannot_be_measured_is_refused_with_the_bound_and_nothing_is_stored(run, data, light, words, says):
    done = run("latency", *ME, *words)
    assert done.exit_code == 2, done.stdout
    assert says in done.stderr
    assert query(data, "SELECT * FROM qa_runs") == []


def test_a_simulated_line_switches_no_light(run, data):
    refused = run("latency", *ME, "--output-delay-ms", 5)
    assert refused.exit_code == 2
    assert "a simulated beam line switches no light" in refused.stderr
    assert query(data, "SELECT * FROM qa_runs") == []


def test_nothing_is_measured_while_a_session_is_created(run, data, light, monkeypatch):
    run("latency", *ME, "--simulated", "--seconds", SECONDS)
    monkeypatch.setattr("service.qa.runs.queries.open_session_id", lambda _db: "c" * 32)
    refused = by_light(run)
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
