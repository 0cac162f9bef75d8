"""Whole fractions over real HTTP: delivered, broken off, resumed; what was seen live is what was recorded."""

import json
import subprocess
import sys

import pytest

from tests.support.planning.failing_client import EVERY_FAULT, ScriptedFaultClient
from tests.support.planning.treatment_services import Elsewhere, clocked, fraction_of, quick_room
from tests.support.repository import ROOT
from tests.support.waiting import eventually

pytestmark = [pytest.mark.waiting, pytest.mark.long]


def test_a_whole_fraction_is_delivered_and_what_was_seen_live_was_recorded(tmp_path):
    with quick_room(tmp_path) as room, room.client() as tps:
        report = fraction_of(room, tps, tmp_path).run()
        actors = {row["actor"] for row in tps.audit(session_id=report.stretches[0].session_id)}
    assert report.is_good, report
    assert [beam.delivered_s >= beam.planned_s for beam in report.beams] == [True, True]
    assert sum(beam.delivered_s - beam.planned_s for beam in report.beams) < 1.0
    (session,) = report.stretches
    assert session.status == "stopped"
    assert session.beam_edges >= 2
    assert any(actor.startswith("key:") for actor in actors)


def test_a_bad_day_changes_nothing_but_the_time_it_takes(tmp_path):
    with quick_room(tmp_path) as room:
        faulty = ScriptedFaultClient(room.url, key=room.key, operator="Simulated therapist")
        report = fraction_of(room, faulty, tmp_path).run()
        faulty.close()
    assert report.is_good, report
    assert faulty.counts.keys() == EVERY_FAULT, f"not every fault was injected: {faulty.counts}"


def test_a_killed_service_is_waited_for_and_a_person_has_the_rest_of_the_fraction_delivered(tmp_path):
    with quick_room(tmp_path, has_therapist=True) as room, room.client() as tps, room.therapist() as therapist:
        run = fraction_of(room, tps, tmp_path, therapist=therapist)
        treatment = Elsewhere(run.run)
        eventually(lambda: [one for one in clocked(run) if one.on_s > 0.4] != [], within_s=30.0)
        room.kill()
        room.start()
        report = treatment.result(within_s=60.0)
    assert report.is_good, report
    first, second = report.stretches
    assert (first.status, second.status) == ("interrupted", "stopped")
    assert first.live_on_s >= 0.4
    assert second.recorded_on_s < 1.6 + 0.5 - first.live_on_s, "what was delivered is not delivered again"


def test_the_command_states_by_its_exit_code_and_its_report_what_came_of_it(tmp_path):
    with quick_room(tmp_path, "--fault-at", "200") as room:
        command = [sys.executable, "-m", "service.cli", "simulate-tps", "--url", room.url]
        given = {
            "--recording": "chest.oni",
            "--calibration": str(tmp_path / "calibration.json"),
            "--beam-seconds": "30",
            "--lower-mm": "-2.5",
            "--out": str(tmp_path / "out"),
        }
        ran = subprocess.run(
            [*command, *(part for pair in given.items() for part in pair)],
            env={**room.environment, "TPS_KEY": room.key},
            cwd=ROOT,
            check=False,
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert ran.returncode == 1, ran.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (fraction,) = report["fractions"]
    assert fraction["faults"] == ["frame_stale"]
    assert "a person has to" in fraction["outcome"]
    assert "frame_stale" in ran.stdout
    assert room.key not in ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--url", "http://gating.example"], "must be https"),
        (["--plan", "no-such-file.dcm"], "No such file"),
        (["--key-file", "no-such-file"], "No such file"),
    ],
)
def test_what_cannot_be_tried_is_one_line_and_exit_code_2(given, said, tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from service.cli import app

    monkeypatch.setenv("TPS_KEY", "tg_1_2")
    ran = CliRunner().invoke(app, ["simulate-tps", "--out", str(tmp_path), *given])
    assert ran.exit_code == 2
    assert said in ran.output
