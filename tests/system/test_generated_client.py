"""A client that a public generator makes of the contract: every operation, and a session with the real service."""

import json
import subprocess
from pathlib import Path

import pytest

from tests.support.repository import ROOT
from tests.support.service.accounts import provision
from tests.support.service.processes import free_port, service_process

pytestmark = [pytest.mark.slow, pytest.mark.waiting, pytest.mark.verification]

ENVIRONMENT = ROOT / ".venv-client-generator" / "bin"
CONTRACT = ROOT / "openapi" / "openapi.json"
OPERATIONS = sorted(
    operation["operationId"]
    for item in json.loads(CONTRACT.read_text(encoding="utf-8"))["paths"].values()
    for operation in item.values()
)
SESSION = """
import json, sys, time
from threading import Event
from pathlib import Path
from generated import AuthenticatedClient
from generated.api.calibrations import upload_calibration
from generated.api.sessions import create_session, export_report_html, read_session, read_trace
from generated.api.sessions import start_session, stop_session
from generated.models import OperatorRequest, Problem, SessionRequest, UploadedCalibration
from generated.models import UploadCalibrationJsonTidegateCalibration1 as Document

url, key, folder = sys.argv[1:]
volunteer = Path(folder)
client = AuthenticatedClient(base_url=url, token=key, timeout=60.0)
document = Document.from_dict(json.loads((volunteer / "calibration.json").read_text()))
calibration = upload_calibration.sync(client=client, body=document, operator="B. Physicist")
assert isinstance(calibration, UploadedCalibration), calibration
source = {"kind": "recording", "path": f"{volunteer.name}/recording.oni", "player": "reader"}
window = {"kind": "amplitude", "signal": "whole", "lower_mm": -2.0, "upper_mm": 2.0}
names = {"patient_reference": "P-0001", "plan_id": "PLAN-1", "fraction_id": "FX-1", "operator": "A. Therapist"}
request = SessionRequest.from_dict({**names, "source": source, "window": window, "calibration_id": calibration.id})
session = create_session.sync(client=client, body=request)
by = OperatorRequest(operator="A. Therapist")
refused = read_trace.sync(session.id, client=client)
assert isinstance(refused, Problem) and refused.code == "session_state", refused
start_session.sync(session.id, client=client, body=by)
deadline = time.monotonic() + 60.0
while (read_session.sync(session.id, client=client).summary.frames or 0) < 30:
    assert time.monotonic() < deadline, "no frames"
    Event().wait(0.1)
stopped = stop_session.sync(session.id, client=client, body=by.to_dict())
trace = read_trace.sync(session.id, client=client, points=10)
html = export_report_html.sync_detailed(session.id, client=client).content
print(json.dumps({"status": str(stopped.status.value), "ranges": len(trace.times_s), "html": len(html)}))
"""


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("generated")
    assert ENVIRONMENT.is_dir(), "not there: run `make setup`"
    command = [str(ENVIRONMENT / "openapi-python-client"), "generate", "--path", str(CONTRACT)]
    command += ["--meta", "none", "--output-path", str(folder / "generated")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_it_has_every_operation(generated: Path):
    made = sorted(path.stem for path in (generated / "generated" / "api").glob("*/*.py") if path.stem != "__init__")
    assert made == OPERATIONS


def test_a_session_with_the_real_service(generated: Path, calm_volunteer: Path, tmp_path: Path):
    data, port = tmp_path / "data", free_port()
    key = provision(data, people={}).key["Authorization"].removeprefix("Bearer ")
    command = ["service.cli", "serve", "--port", str(port), "--data", str(data)]
    with service_process(
        *command, "--recordings", str(calm_volunteer.parent), port=port, log=tmp_path / "log", data=data
    ):
        done = subprocess.run(
            [str(ENVIRONMENT / "python"), "-c", SESSION, f"http://127.0.0.1:{port}", key, str(calm_volunteer)],
            cwd=generated,
            capture_output=True,
            text=True,
            timeout=180,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["status"], found["ranges"]) == ("stopped", 10)
    assert found["html"] > 1000
