"""The examples of plug-ins: built, installed, held to the rules, and run through a session.

The service is a real one; the camera plays a phantom as if it were live, and the beam line's device is the test's.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.service.api_calls import act, audit_rows, upload
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually
from verification.plug_ins.text_line import DROP_S, text_line

pytestmark = pytest.mark.alone

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "plug_ins"
WIDE = {"signal": "whole", "lower_mm": -40.0, "upper_mm": 40.0, "hysteresis_mm": 0.2, "dwell_ms": 100.0}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Both examples, installed into a folder as pip installs them, without their sources."""
    folder = tmp_path_factory.mktemp("plug-ins")
    for name in ("camera", "beam_line"):
        copy = folder / f"source-{name}"
        subprocess.run(["cp", "-r", EXAMPLES / name, copy], check=True)
        uv = [Path(sys.executable).with_name("uv"), "pip", "install", "--quiet", "--python", sys.executable]
        subprocess.run([*uv, "--target", folder / "site", "--no-deps", "--no-build-isolation", copy], check=True)
    return folder


@pytest.fixture
def environment(site, calm_volunteer):
    return {"PYTHONPATH": str(site / "site"), "LOOP_RECORDING": str(calm_volunteer / "recording.oni")}


def ran(arguments, environment, **options):
    given = {**os.environ, **environment}
    return subprocess.run(arguments, env=given, capture_output=True, text=True, check=False, **options)


def test_a_stranger_s_tests_hold_both_to_the_rules(site, environment):
    with text_line() as (_, port):
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
        for name in ("camera", "beam_line"):
            ended = ran(
                [*command, "--rootdir", site / f"source-{name}", site / f"source-{name}"],
                {**environment, "TEXT_LINE": f"127.0.0.1:{port}"},
                cwd=site,
            )
            assert ended.returncode == 0, ended.stdout


def test_a_session_runs_on_both_and_a_killed_service_leaves_no_beam_on(environment, calm_volunteer, tmp_path):
    port, log = free_port(), tmp_path / "log"
    with text_line() as (device, line_port):
        settings = {
            **environment,
            "TIDEGATE_BEAM_LINE": "plug-in",
            "TIDEGATE_BEAM_PLUG_IN": f"text:127.0.0.1:{line_port}",
            "TIDEGATE_MAX_DUTY_PERCENT": "100",
            "TIDEGATE_OPERATOR_TIMEOUT_S": "0",
        }
        arguments = ("service.cli", "serve", "--port", str(port), "--data", str(tmp_path / "data"))
        with service_process(*arguments, port=port, log=log, environment=settings, data=tmp_path / "data") as (
            process,
            client,
        ):
            devices = client.get("/api/v1/devices").json()
            assert [one["uri"] for one in devices.get("items", [])] == ["loop:1"], devices
            assert devices["kinds"][0]["plug_in"] == "tidegate-loop 0.1.0"
            (start,) = audit_rows(client, "service.start")
            assert client.get("/api/v1/machine").json()["plug_ins"] == start["detail"]["plug_ins"]
            assert [one.split("=")[0] for one in start["detail"]["plug_ins"]] == [
                "tidegate-loop 0.1.0: loop",
                "tidegate-text-line 0.1.0: text",
            ]
            body = {
                "patient_reference": "P-1",
                "plan_id": "PLAN",
                "fraction_id": "FX",
                "operator": "A. Therapist",
                "source": {"kind": "device", "uri": "loop:1"},
                "calibration_id": upload(client, (calm_volunteer / "calibration.json").read_bytes()).json()["id"],
                "head_direction": "top",
                "window": WIDE,
            }
            created = client.post("/api/v1/sessions", json=body)
            assert created.status_code == 201, created.text
            session_id = created.json()["id"]
            (made,) = audit_rows(client, "session.create")
            assert made["detail"]["plug_ins"] == ["tidegate-loop 0.1.0", "tidegate-text-line 0.1.0"]
            assert act(client, session_id, "start").status_code == 200

            answers = []

            def is_armed():
                detail = client.get(f"/api/v1/sessions/{session_id}").json()
                if detail["gate"]["state"] == "fault":  # a busy machine's: a line that was answered late
                    act(client, session_id, "acknowledge")
                elif detail["measurement_state"] == "measuring" and not detail["gate"]["is_armed"]:
                    _ = detail["has_reference"] or act(client, session_id, "reference")
                    answers.append(act(client, session_id, "arm").text[:600])
                answers[:-3] = []
                return device.is_closed

            eventually(is_armed, pause_s=0.05, detail=lambda: answers)
            process.kill()
            killed_ns = time.monotonic_ns()
            eventually(lambda: not device.is_closed)
            assert (device.edges[-1][1] - killed_ns) / 1e9 < 2.0 * DROP_S + 0.5


def test_clinical_mode_runs_only_what_the_site_lists(environment):
    code = (
        "from types import SimpleNamespace as S; from service.engine_host.plug_ins import use_plug_ins;"
        "from engine.core.plug_ins import find_plug_ins, CAMERAS;"
        "sha = find_plug_ins(CAMERAS)[0].sha256;"
        "print(len(sha), [one.name for one in use_plug_ins(S(allowed_plug_ins={}, beam_plug_in=''))],"
        " [one.name for one in use_plug_ins(S(allowed_plug_ins={'loop': sha}, beam_plug_in=''))])"
    )
    assert ran([sys.executable, "-c", code], environment, cwd=ROOT).stdout == "64 [] ['loop']\n"
    other = code.replace("'loop': sha", "'loop': '0' * 64")
    assert "site.plug_ins lists loop=000" in ran([sys.executable, "-c", other], environment, cwd=ROOT).stderr
    unlisted = code.replace("beam_plug_in=''", "beam_plug_in='text:a:1'")
    said = ran([sys.executable, "-c", unlisted], environment, cwd=ROOT).stderr
    assert "site.plug_ins does not list text: tidegate-text-line 0.1.0 may run once it has text=" in said
    absent = code.replace("beam_plug_in=''", "beam_plug_in='none:a:1'")
    said = ran([sys.executable, "-c", absent], environment, cwd=ROOT).stderr
    assert "no installed distribution has tidegate.beam_lines none" in said


def test_a_module_that_hides_the_hashed_one_is_not_imported(environment, tmp_path):
    (tmp_path / "tidegate_loop.py").write_text("raise SystemExit('it ran')")
    code = "from engine.core.plug_ins import find_plug_ins, CAMERAS; find_plug_ins(CAMERAS)[0].load()"
    hidden = environment | {"PYTHONPATH": f"{tmp_path}:{environment['PYTHONPATH']}"}
    said = ran([sys.executable, "-c", code], hidden, cwd=ROOT).stderr
    assert f"would be imported from {tmp_path}/tidegate_loop.py, which is no file of tidegate-loop 0.1.0" in said
    assert ran([sys.executable, "-c", code], environment, cwd=ROOT).stderr == ""
