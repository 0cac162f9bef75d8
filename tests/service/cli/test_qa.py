"""``tidegate qa``: what it prints, what it refuses, its exit codes, and a line that is off however it ends."""

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from engine.core.errors import BeamLineError
from engine.qa.checks import CHECKS, checks_of
from engine.qa.results import QaKind
from service.cli import app
from service.storage.files.folder_lock import alone_in
from tests.support.beam.receivers import REGISTERS, receiver
from tests.support.qa.fake_rig import FakeRig
from tests.support.qa.plate_recording import record_virtual_plate
from tests.support.qa.sample_runs import report, sample_series
from tests.support.repository import ROOT
from tests.support.site_settings import give_settings, with_config
from tests.support.waiting import eventually

pytestmark = [
    pytest.mark.long,
    pytest.mark.slow,
    pytest.mark.verification,
    pytest.mark.usefixtures("no_settings_around"),
]

ME = ("--operator", "A. Physicist")
PATIENCE_S = 120.0
NEEDED_OF_A_SESSION = (
    *("status_detail", "patient_reference", "plan_id", "fraction_id", "operator", "source", "window", "calibration_id"),
)


@pytest.fixture(scope="module")
def plate(tmp_path_factory) -> Path:
    return record_virtual_plate(tmp_path_factory.mktemp("plate"))


@pytest.fixture
def data(tmp_path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def run(data):
    """Run ``tidegate qa`` with this test's data folder."""
    return lambda *arguments: CliRunner().invoke(app, ["qa", *map(str, arguments), "--data", str(data)])


@pytest.fixture
def rig(monkeypatch):
    """Runs that end at once, as a test says."""
    rig = FakeRig()
    rig.go_on.set()
    monkeypatch.setattr("service.cli.qa.run.SimulatingRig", lambda _settings: rig)
    return rig


def rows(data, query):
    raw = sqlite3.connect(data / "tidegate.db")
    try:
        return raw.execute(query).fetchall()
    finally:
        raw.close()


def verdicts(printed: str) -> dict[str, str]:
    """The verdict of each check, by its title, as printed."""
    cells = [[cell.strip() for cell in line.split("│")] for line in printed.splitlines() if "│" in line]
    return {cell[0]: cell[-1] for cell in cells}


def test_a_plate_is_judged_by_the_baseline_that_a_person_took_over_from_it(run, data, plate, tmp_path):
    daily = ("daily", *ME, "--plate", plate, "--repeats", "5", "--out", tmp_path / "r.pdf")
    first = run(*daily)
    assert first.exit_code == 1, first.stderr
    assert verdicts(first.stdout)["Camera distance"] == "FAIL"
    assert "no baseline was fixed" in first.stdout
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")
    run_id = rows(data, "SELECT id FROM qa_runs")[0][0]
    fixed = run("baseline", *ME, "--reason", "commissioning", "--from-run", run_id[:8])
    assert fixed.exit_code == 0, fixed.stderr
    assert "commissioning" in fixed.stdout
    second = run(*daily)
    reported = verdicts(second.stdout)
    for title in (
        "Camera distance",
        "Camera angle across the couch",
        "Camera angle along the couch",
        "Noise of a pixel",
    ):
        assert reported[title] == "PASS", second.stdout
    assert 849.0 < float(rows(data, "SELECT value FROM qa_results WHERE code = 'camera_distance_mm'")[0][0]) < 851.0
    camera = rows(data, "SELECT camera FROM calibrations")
    assert camera == [("virtual QA camera",)]
    actions = [action for (action,) in rows(data, "SELECT action FROM audit ORDER BY sequence")]
    assert actions == ["calibration.upload", "qa.start", "qa.end", "qa.baseline", "qa.start", "qa.end"]


@pytest.mark.parametrize(
    ("values", "code", "word"),
    [({}, 0, "PASS"), ({"plate_noise_mm": 2.5}, 3, "WARN"), ({"plate_noise_mm": 3.5}, 1, "FAIL")],
    ids=["pass", "warn", "fail"],
)
def test_the_exit_code_is_the_verdict(run, rig, values, code, word):
    rig.report = report(QaKind.DAILY, **values)
    done = run("daily", *ME, "--simulated")
    assert done.exit_code == code, done.stderr
    assert done.stdout.splitlines()[-1].startswith(f"{word}  run ")
    assert verdicts(done.stdout)["Noise of a pixel"] == word


def test_a_run_that_cannot_be_done_is_no_pass_and_is_kept(run, rig, data):
    rig.fail_with = BeamLineError("the line does not answer")
    done = run("daily", *ME, "--simulated")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "failed: the line does not answer" in done.stderr
    assert rows(data, "SELECT status, verdict FROM qa_outcomes") == [("failed", None)]


def test_every_check_of_the_kind_is_printed_with_its_verdict(run, rig):
    rig.report = report(QaKind.ANNUAL, motion_lag_ms=None)
    done = run("annual", *ME, "--simulated")
    reported = verdicts(done.stdout)
    assert {check.title for check in checks_of(QaKind.ANNUAL)} <= reported.keys()
    assert reported["Lag of the measured motion"] == "FAIL"
    assert "not measured" in done.stdout


def test_runs_are_listed_followed_and_printed_later_also_beside_a_service(run, rig, data, tmp_path):
    for noise in (1.0, 2.5):
        rig.report = report(QaKind.DAILY, series=sample_series()[:1], plate_noise_mm=noise)
        run("daily", *ME, "--simulated")
    run_id = rows(data, "SELECT id FROM qa_runs ORDER BY created_at DESC")[0][0]
    with alone_in(data):
        listed = run("list")
        assert listed.exit_code == 0
        assert "daily (simulated)" in listed.stdout
        assert [line.split()[-1] for line in listed.stdout.splitlines()[2:]] == ["WARN", "PASS"]
        trend = run("trend", "plate_noise_mm")
        assert trend.exit_code == 0
        assert "[mm]" in trend.stdout
        printed = run("report", run_id[:8], "--out", tmp_path / "later.pdf")
        assert printed.exit_code == 0, printed.stderr
        assert (tmp_path / "later.pdf").read_bytes().startswith(b"%PDF")
        assert "never" in run("baseline").stdout
        for refused in (
            run("daily", *ME, "--simulated"),
            run("baseline", *ME, "--reason", "x", "--camera-distance-mm", "850"),
        ):
            assert refused.exit_code == 2
            assert refused.stderr.count("\n") == 1
            assert "is in use" in refused.stderr


def test_the_checks_are_listed_with_the_bounds_of_the_site(run, data, monkeypatch, tmp_path):
    data.mkdir()
    give_settings(monkeypatch, tmp_path, qa_plate_noise_mm_warn=1.25)
    listed = run("checks")
    assert listed.exit_code == 0
    assert all(check.code in listed.stdout for check in CHECKS)
    assert "1.25 mm" in listed.stdout


def test_a_plate_recording_has_its_calibration_beside_it(run, plate, tmp_path):
    alone = tmp_path / "plate.oni"
    alone.write_bytes(plate.read_bytes())
    assert "calibration.json" in run("daily", *ME, "--plate", alone).stderr


REFUSALS = [
    (("daily", *ME), "plate"),
    (("daily",), "--operator"),
    (("daily", "--operator", " ", "--simulated"), "operator"),
    (("daily", *ME, "--simulated", "--plate", "PLATE"), "plate"),
    (("daily", *ME, "--simulated", "--seed", "-1"), "simulation.seed"),
    (("daily", *ME, "--simulated", "--fault-offset-mm", "11"), "offset_mm"),
    (("daily", *ME, "--plate", "PLATE", "--part", "1.5"), "plate.part"),
    (("daily", *ME, "--plate", "PLATE", "--seconds", "nan"), "plate.seconds"),
    (("daily", *ME, "--plate", "PLATE", "--repeats", "4"), "beam.repeats"),
    (("daily", *ME, "--plate", "PLATE", "--pulse", "201"), "beam.pulse_ms"),
    (("daily", *ME, "--plate", "PLATE", "--note", "x" * 501), "note"),
    (("daily", *ME, "--plate", "device"), "calibration_id"),
    (("daily", *ME, "--plate", "ABSENT", "--calibration", "CALIBRATION"), "absent.oni: cannot be read"),
    (("monthly", *ME, "--plate", "PLATE"), "phantom"),
    (("monthly", *ME, "--plate", "PLATE", "--phantom", "PLATE"), "--trace"),
    (("monthly", *ME, "--plate", "PLATE", "--phantom", "PLATE", "--trace", "x", "--window", "3"), "--window"),
    (("monthly", *ME, "--plate", "PLATE", "--phantom", "PLATE", "--trace", "x", "--window", "5:3"), "window_lower_mm"),
    (("monthly", *ME, "--plate", "PLATE", "--phantom", "PLATE", "--trace", "absent", "--window", "3:99"), "absent"),
    (("trend", "plate_noise_mm"), "no data folder"),
    (("report", "ab", "--out", "OUT"), "no data folder"),
    (("baseline", "--camera-distance-mm", "850"), "--operator"),
    (("baseline", *ME, "--reason", "x", "--camera-distance-mm", "10"), "camera_distance_mm"),
    (("baseline", *ME, "--reason", "", "--camera-distance-mm", "850"), "--reason"),
    (("baseline", *ME, "--reason", "x", "--camera-distance-mm", "850", "--from-run", "ab"), "not both"),
    (("baseline", *ME, "--reason", "x", "--from-run", "ab"), "no such QA run"),
]


@pytest.mark.parametrize(("arguments", "said"), REFUSALS, ids=lambda part: str(part)[-40:])
def test_what_cannot_be_done_is_refused_in_words_and_nothing_is_kept(run, data, plate, tmp_path, arguments, said):
    places = {"PLATE": str(plate), "OUT": str(tmp_path / "out.pdf"), "ABSENT": str(tmp_path / "absent.oni")}
    places["CALIBRATION"] = str(plate.parent / "calibration.json")
    refused = run(*(places.get(word, word) for word in arguments))
    assert refused.exit_code == 2, refused.stdout
    assert said in refused.stderr
    assert "Traceback" not in refused.stderr
    if (data / "tidegate.db").exists():
        assert rows(data, "SELECT * FROM qa_runs") == []
        assert rows(data, "SELECT * FROM qa_baselines") == []


def test_an_unknown_check_and_an_unknown_run_are_refused(run, rig, tmp_path):
    run("daily", *ME, "--simulated")
    assert "one of camera_distance_mm" in run("trend", "absent").stderr
    assert "no such QA run" in run("report", "zz", "--out", tmp_path / "x.pdf").stderr
    assert not (tmp_path / "x.pdf").exists()


def real_line(far) -> dict[str, str]:
    names = {
        "LINE": "modbus-tcp",
        "MODBUS_HOST": "127.0.0.1",
        "MODBUS_PORT": far.where,
        "MODBUS_UNIT": REGISTERS.unit,
        "MODBUS_PERMIT_COIL": REGISTERS.permit_coil,
        "MODBUS_HEARTBEAT_REGISTER": REGISTERS.heartbeat_register,
        "MODBUS_READBACK_INPUT": REGISTERS.readback_input,
        "ANSWER_MS": 150,
        "SETTLE_MS": 10,
    }
    return {f"TIDEGATE_BEAM_{name}": str(value) for name, value in names.items()}


def test_a_real_line_is_not_even_opened_without_the_word_that_the_beam_is_safe(run, plate, data, monkeypatch):
    with receiver("tcp") as far:
        for name, value in with_config(real_line(far), data.parent).items():
            monkeypatch.setenv(name, value)
        refused = run("daily", *ME, "--plate", plate)
        assert refused.exit_code == 2
        assert "is_beam_safe" in refused.stderr
    assert far.seen == []


def test_a_real_line_is_not_opened_while_a_session_is_created(run, plate, rig, data, monkeypatch):
    run("daily", *ME, "--simulated")
    with contextlib.closing(sqlite3.connect(data / "tidegate.db")) as raw, raw:
        values = {"id": "c" * 32, "status": "created", "is_simulated_beam": 0, "created_at": "2026-01-01"}
        values |= dict.fromkeys(NEEDED_OF_A_SESSION, "")
        raw.execute(
            f"INSERT INTO sessions ({','.join(values)}) VALUES ({','.join('?' * len(values))})", [*values.values()]
        )
    for name, value in {"LINE": "modbus-tcp", "MODBUS_HOST": "127.0.0.1"}.items():
        monkeypatch.setenv(f"TIDEGATE_BEAM_{name}", value)
    refused = run("daily", *ME, "--plate", plate, "--yes-the-beam-is-safe")
    assert refused.exit_code == 2
    assert "a session is created or running" in refused.stderr
    assert not rig.job_now.is_on.is_set()
    assert len(rows(data, "SELECT * FROM qa_runs")) == 1


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda how: how.name)
def test_however_a_run_is_ended_the_real_line_is_off_and_the_run_no_pass(data, plate, how):
    with receiver("tcp") as far:
        process = _permitting(far, data, plate)
        process.send_signal(how)
        try:
            code = process.wait(PATIENCE_S)
        finally:
            process.kill()
        eventually(lambda: not far.is_on, within_s=30.0)
        time.sleep(0.5)
        assert not far.is_on
    assert far.seen[-1][0] == "off"
    assert code == (-signal.SIGKILL if how is signal.SIGKILL else 130)
    ended = rows(data, "SELECT status, verdict FROM qa_outcomes")
    assert ended == ([] if how is signal.SIGKILL else [("cancelled", None)])
    if how is signal.SIGKILL:
        environment = {"TIDEGATE_DATA_DIR": str(data)}
        again = _tidegate("qa", "daily", *ME, "--simulated", environment=environment)
        assert again.wait(PATIENCE_S) == 0
        assert ("interrupted",) in rows(data, "SELECT status FROM qa_outcomes")


def _ended_or_on(process, far) -> bool:
    return process.poll() is not None or far.is_on


def _permitting(far, data, plate) -> subprocess.Popen:
    """Start a run on a real line, and return once the line was seen on; again where a busy machine failed the line."""
    word = "--yes-the-beam-is-safe"
    for _ in range(5):
        process = _tidegate(
            *("qa", "daily", *ME, "--plate", str(plate), "--repeats", "1000", word),
            environment={**real_line(far), "TIDEGATE_DATA_DIR": str(data)},
        )
        eventually(
            partial(_ended_or_on, process, far),
            within_s=PATIENCE_S,
            pause_s=0.002,
            detail=lambda: "the line was never on",
        )
        if process.poll() is None:
            return process
        for path in data.glob("tidegate.db*"):
            path.unlink()
    pytest.fail("the run never got as far as the line")


def _tidegate(*words: str, environment: dict[str, str]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "service.cli", *words],
        cwd=ROOT,
        env=os.environ | with_config(environment, Path(environment["TIDEGATE_DATA_DIR"]).parent),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def test_the_calibration_that_was_used_can_be_found_again(run, data, plate, rig):
    run("daily", *ME, "--plate", plate)
    reported = json.loads(rows(data, "SELECT request FROM qa_runs")[0][0])
    assert rows(data, "SELECT sha256 FROM calibrations") == [(reported["calibration_sha256"],)]
