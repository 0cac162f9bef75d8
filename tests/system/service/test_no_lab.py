"""A clinical service loads nothing of the lab; a research one loads it with its first simulated QA run."""

import json

import pytest

from tests.support.service.clinical_site import CLINICAL, environment
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually

pytestmark = pytest.mark.waiting

PROGRAM = """
import os, sys
found = open(os.environ["FOUND"], "a", buffering=1)
def note(event, arguments):
    if event == "import" and str(arguments[0]).partition(".")[0] == "lab":
        found.write(arguments[0] + "\\n")
sys.addaudithook(note)
from service.cli import app
app(sys.argv[1:])
"""
DAILY = {"kind": "daily", "simulation": {"seed": 1}, "beam": {"repeats": 5}}


@pytest.mark.parametrize("mode", ["clinical", "research"])
def test_only_a_research_service_loads_the_lab_and_only_for_a_simulated_run(tmp_path, mode):
    port, found = free_port(), tmp_path / "found"
    found.touch()
    (tmp_path / "noting.py").write_text(PROGRAM)
    site = {f"TIDEGATE_{name}": value for name, value in environment(CLINICAL).items()} if mode == "clinical" else {}
    started = service_process(
        "noting",
        *("serve", "--port", str(port), "--data", str(tmp_path / "data")),
        port=port,
        log=tmp_path / "log",
        data=tmp_path / "data",
        environment={**site, "PYTHONPATH": str(tmp_path), "FOUND": str(found)},
    )
    with started as (_, client):
        client.get("/api/v1/qa/status").raise_for_status()
        assert found.read_text() == ""
        answer = client.post("/api/v1/qa/runs", json=DAILY)
        if mode == "clinical":
            assert answer.status_code == 422, answer.text
            assert "simulat" in json.dumps(answer.json())
        else:
            assert answer.status_code == 202, answer.text
            run_id = answer.json()["id"]
            eventually(
                lambda: client.get(f"/api/v1/qa/runs/{run_id}").json()["status"] == "finished",
                within_s=120.0,
                pause_s=0.2,
            )
    assert ("lab.virtual_qa" in found.read_text()) is (mode == "research")
