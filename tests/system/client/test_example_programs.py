"""The samples in docs/4-integrate/clients, compiled and run: a whole fraction each, against a real service."""

import csv
import subprocess

import pytest

from lab.simulated_tps.prescription import built_in_plan
from tests.support.planning.treatment_services import quick_room
from tests.support.repository import ROOT

pytestmark = pytest.mark.waiting

SAMPLES = ROOT / "docs" / "4-integrate" / "clients"
LIBRARIES = ("System.Net.Http", "System.Runtime.Serialization", "System.Xml", "System.Xml.Linq")
SECONDS = 1.0


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    with quick_room(tmp_path_factory.mktemp("room")) as room:
        yield room


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The C# sample, compiled."""
    made = tmp_path_factory.mktemp("program") / "Program.exe"
    references = [f"-r:{library}" for library in LIBRARIES]
    command = ["mcs", "-warnaserror", f"-out:{made}", *references, str(SAMPLES / "Program.cs")]
    compiled = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert compiled.returncode == 0, compiled.stdout + compiled.stderr
    return made


def run(room, folder, command, *, number, recording="chest.oni", key=None):
    plan = folder / "plan.dcm"
    plan.write_bytes(built_in_plan(uid=f"1.2.826.0.1.3680043.8.498.1.7.{number}", patient_id=f"P-{number}"))
    calibration = room.folder / "calibration.json"
    arguments = [str(plan), str(calibration), recording, str(SECONDS), str(folder / f"out-{number}")]
    return subprocess.run(
        [*command, *arguments],
        env={**room.environment, "TIDEGATE_URL": room.url, "TPS_KEY": key or room.key},
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )


def check(ran, room, samples):
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "delivered 1." in ran.stdout
    assert room.key not in ran.stdout + ran.stderr
    with samples.open(newline="") as file:
        rows = list(csv.DictReader(file))
    on = sum(row["gate"] == "beam_on" for row in rows)
    assert SECONDS * 30 <= on <= (SECONDS + 0.7) * 30
    with room.client() as client:
        session = next(client.sessions())
    assert session["status"] == "stopped"


def test_a_fraction_with_curl(room, tmp_path):
    ran = run(room, tmp_path, ["bash", str(SAMPLES / "curl.sh")], number=1)
    check(ran, room, tmp_path / "out-1" / "samples.csv")


def test_a_fraction_with_c_sharp(room, program, tmp_path):
    ran = run(room, tmp_path, ["mono", str(program)], number=2)
    check(ran, room, tmp_path / "out-2" / "samples.csv")


@pytest.mark.parametrize("kind", ["curl", "c_sharp"])
def test_a_refusal_is_reported_by_its_code_and_leaves_no_session_open(kind, room, program, tmp_path):
    command = ["bash", str(SAMPLES / "curl.sh")] if kind == "curl" else ["mono", str(program)]
    ran = run(room, tmp_path, command, number=3 if kind == "curl" else 4, recording="../../etc/passwd")
    assert ran.returncode == 1
    assert "422 invalid_value" in ran.stderr
    with room.client() as client:
        assert [one["status"] for one in client.sessions() if one["status"] in {"created", "running"}] == []
