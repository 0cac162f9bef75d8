"""QA with nothing faked: the engine's own run over HTTP on the virtual set-up, and what the rig makes of a request."""

import subprocess

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, SourceLostError
from engine.qa.results import QaKind
from service.core.errors import BoundError
from service.core.settings.settings import Settings
from service.qa.jobs import QaFiles
from service.qa.rig import EngineRig
from service.qa.schemas import QaRunRequest
from service.qa.virtual_setups import SimulatingRig
from service.web.app import create_app
from tests.support.capture.fake_driver import FakeDriver, use
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import make_calibration
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

ME = {"operator": "A. Physicist"}
PATIENCE_S = 240.0


def test_a_virtual_daily_run_is_passed_kept_printed_and_counts_for_nothing(settings, engine, tmp_path):
    strict = Settings(**settings.model_dump(exclude_unset=True), qa_required_daily_h=24.0)
    with PeopleClient(create_app(strict, lambda _settings: engine, SimulatingRig)) as client:
        begun = client.post("/api/v1/qa/runs", json={"kind": "daily", **ME, "simulation": {"seed": 3}})
        assert begun.status_code == 202
        url = f"/api/v1/qa/runs/{begun.json()['id']}"
        early = client.get(f"{url}/report.pdf")
        assert (early.status_code, early.json()["code"]) == (409, "qa_state")
        eventually(lambda: client.get(url).json()["status"] != "running", within_s=PATIENCE_S)
        ended = client.get(url).json()
        assert (ended["status"], ended["verdict"], ended["is_simulated"]) == ("finished", "pass", True)
        paper = client.get(f"{url}/report.pdf")
        assert paper.headers["content-type"] == "application/pdf"
        (tmp_path / "r.pdf").write_bytes(paper.content)
        text = subprocess.run(["pdftotext", tmp_path / "r.pdf", "-"], check=True, capture_output=True, text=True).stdout
        assert "SIMULATED FROM END TO END" in text
        assert client.get(f"{url}/report.pdf").content == paper.content
        assert client.get("/api/v1/qa/status").json()["is_arming_allowed"] is False


def test_without_the_lab_a_simulated_run_is_refused_by_name(settings, monkeypatch):
    monkeypatch.setattr("service.qa.virtual_setups._installed", lambda: None)
    request = QaRunRequest.model_validate({"kind": "daily", **ME, "simulation": {"seed": 3}})
    with pytest.raises(BoundError, match=r"simulation must be omitted: .*tidegate\[lab\]") as refusal:
        SimulatingRig(settings).job(request, QaFiles(), None)
    assert refusal.value.field == "simulation"


@pytest.fixture
def trace(tmp_path):
    path = tmp_path / "sine.csv"
    seconds = np.arange(0.0, 60.0, 0.05)
    rows = (f"{at:.3f},{10.0 - 10.0 * np.cos(2.0 * np.pi * at / 4.0):.4f}" for at in seconds)
    path.write_text("\n".join(["time_s,position_mm", *rows]), encoding="utf-8")
    return path


def monthly(**phantom) -> QaRunRequest:
    source = {"kind": "recording", "path": "x.oni"}
    moved = {"source": source, "trace": "sine.csv", "window_lower_mm": -60.0, "window_upper_mm": 10.0} | phantom
    calls = {"kind": "monthly", **ME, "calibration_id": "0" * 32, "plate": {"source": source}, "phantom": moved}
    return QaRunRequest.model_validate(calls)


def files(tmp_path, trace) -> QaFiles:
    return QaFiles(plate=tmp_path / "plate.oni", phantom=tmp_path / "phantom.oni", trace=trace)


def test_a_run_is_put_together_by_the_site_s_limits_and_the_request_s_numbers(tmp_path, trace):
    site = Settings(min_dwell_ms=250.0, max_residual_mm=3.5, training_min_cycles=2, camera_latency_ms=20.0)
    request = monthly(starts_us=1_000_000, seconds=120.0)
    job = EngineRig(site).job(request, files(tmp_path, trace), make_calibration())
    plate, phantom, beam = job._inputs.plate, job._inputs.phantom, job._inputs.beam
    assert (plate.part, plate.seconds) == (0.5, 120.0)
    assert (phantom.window_mm, phantom.starts_us, phantom.seconds) == ((-60.0, 10.0), 1_000_000, 120.0)
    assert phantom.trace.reach_mm == pytest.approx((0.0, 20.0), abs=0.1)
    limits = phantom.limits
    assert (limits.dwell_ms, limits.max_residual_mm, limits.camera_latency_ms) == (250.0, 3.5, 20.0)
    assert phantom.settings.training.min_cycles == 2
    assert beam.line is job.line
    assert (beam.repeats, beam.pulse_ms) == (20, 200.0)
    assert job.own_baseline is None
    assert job._kind is QaKind.MONTHLY


def test_a_window_that_times_nothing_and_a_camera_that_is_not_there_are_refused_by_name(tmp_path, trace, monkeypatch):
    rig = EngineRig(Settings())
    with pytest.raises(InvalidValueError, match=r"phantom\.window_mm"):
        rig.job(monthly(window_upper_mm=50.0), files(tmp_path, trace), make_calibration())
    use(monkeypatch, FakeDriver())
    live = QaRunRequest.model_validate(
        {"kind": "daily", **ME, "calibration_id": "0" * 32, "plate": {"source": {"kind": "device"}}}
    )
    with pytest.raises(SourceLostError, match="no such camera"):
        rig.job(live, QaFiles(), make_calibration())


def test_without_a_virtual_set_up_a_simulated_run_is_refused_by_name(settings, engine):
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        refused = client.post("/api/v1/qa/runs", json={"kind": "daily", **ME, "simulation": {"seed": 3}})
    assert (refused.status_code, refused.json()["field"]) == (422, "simulation")
    assert "no virtual set-up" in refused.json()["bound"]
