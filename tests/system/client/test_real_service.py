"""The real service, `tidegate serve`: the client alone in its interpreter, and a whole fraction."""

import json
import os
import shutil
import subprocess
import sys

import pytest

from lab.simulated_tps.prescription import built_in_plan
from tests.support.planning.treatment_services import PASSWORD, THERAPIST, treating
from tests.support.repository import ROOT

pytestmark = [pytest.mark.waiting, pytest.mark.long]

PATIENT = {
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_LEASE_MS": "200",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_MAX_GAP_MS": "200",
}
"""A test's machine is shared: what is tested here is the way through, not the time it takes."""

SERVE = ("service.cli", "serve", "--port", "{port}", "--data", "{data}", "--recordings", "{recordings}")
ALONE = """
import sys
assert not any("site-packages" in path for path in sys.path), sys.path
sys.path.insert(0, sys.argv[1])
import client, json, pathlib
url, key, calibration, samples = sys.argv[2], sys.stdin.readline().strip(), *map(pathlib.Path, sys.argv[3:5])
with client.TidegateClient(url, key=key, operator="A. Physicist") as tidegate:
    first = tidegate.upload_calibration(calibration.read_bytes())
    again = tidegate.upload_calibration(calibration.read_bytes())
    try:
        tidegate.create_session({"window": {"lower_mm": -400.0}})
    except client.ProblemError as problem:
        refused = [problem.code, problem.status, problem.field]
    live = next(message["type"] for message in tidegate.live())
    written = tidegate.export_audit(samples)
    loaded = sorted({"service", "engine", "pydantic", "httpx2"} & {name.partition(".")[0] for name in sys.modules})
    print(json.dumps({
        "same": first["id"] == again["id"], "refused": refused, "live": live,
        "asked": tidegate.readiness()["checked_at"],
        "size": written.size, "listed": [one["id"] for one in tidegate.calibrations()] == [first["id"]],
        "me": tidegate.me()["name"], "intact": tidegate.verify_audit()["is_intact"], "loaded": loaded,
    }))
"""


@pytest.fixture(scope="module")
def served(tmp_path_factory, occlusion_volunteer):
    """A service on a volunteer whose view a hand and a hidden sticker disturb, later on."""
    folder = tmp_path_factory.mktemp("served")
    for name in ("recording.oni", "calibration.json"):
        shutil.copy(occlusion_volunteer / name, folder / name)
    with treating(folder, *SERVE, has_therapist=True, **PATIENT) as room:
        yield room


def test_the_client_works_alone_in_an_interpreter_that_sees_nothing_else(served, tmp_path):
    shutil.copy(ROOT / "service" / "client.py", tmp_path / "client.py")
    arguments = [str(tmp_path), served.url, str(served.folder / "calibration.json"), str(tmp_path / "audit.jsonl")]
    ran = subprocess.run(
        [sys.executable, "-I", "-S", "-c", ALONE, *arguments],
        input=served.key + "\n",
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"]},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    reported = json.loads(ran.stdout)
    assert reported.pop("me").startswith("key:")
    assert reported.pop("asked").endswith("Z")
    assert reported.pop("size") == (tmp_path / "audit.jsonl").stat().st_size > 0
    assert reported.pop("refused") == ["invalid_value", 422, "patient_reference"]
    assert reported == {"same": True, "live": "hello", "listed": True, "intact": True, "loaded": []}


def test_a_whole_fraction_of_a_volunteer_is_delivered_with_holds_on_the_way(served, tmp_path):
    plan = tmp_path / "plan.dcm"
    plan.write_bytes(built_in_plan(uid="1.2.826.0.1.3680043.8.498.1.8", beams=(("AP", 8.0), ("LAT", 8.0))))
    given = {
        "--url": served.url,
        "--plan": str(plan),
        "--recording": "recording.oni",
        "--calibration": str(served.folder / "calibration.json"),
        "--lower-mm": "-3",
        "--upper-mm": "6",
        "--acknowledge-as": THERAPIST,
        "--out": str(tmp_path / "out"),
    }
    ran = subprocess.run(
        [sys.executable, "-m", "service.cli", "simulate-tps", *(part for pair in given.items() for part in pair)],
        env={**served.environment, "TPS_KEY": served.key, "TPS_PASSWORD": PASSWORD},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "all checks passed" in ran.stdout
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (fraction,) = report["fractions"]
    assert [beam["planned_s"] for beam in fraction["beams"]] == [0.8, 0.8], "8 MU at 600 MU/min"
    assert all(beam["delivered_s"] >= beam["planned_s"] for beam in fraction["beams"])
