"""``tidegate evaluate integrity``: what it refuses, and what it writes."""

import csv
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from typer.testing import CliRunner

from lab.evaluation.integrity import bench
from lab.evaluation.integrity.session import SIGNALS, Session
from service.cli import app
from tests.support.repository import ROOT
from tests.support.waiting import eventually


def called(*words):
    return CliRunner().invoke(app, ["evaluate", "integrity", *[str(word) for word in words]])


def wrong(case):
    """A session that is wrong by 2 mm for as long as it lasts."""
    frames, shape = 30, (30, len(SIGNALS))
    return Session(
        case=case,
        seconds=np.arange(frames) / 30.0,
        is_measured=np.ones(frames, bool),
        is_held=np.zeros(frames, bool),
        error_mm=np.full(shape, 2.0),
        is_on=np.zeros(shape, bool),
        outside_mm=np.zeros(shape),
        reasons=(),
    )


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["--volunteer", 11], "volunteer"),
        (["--kind", "nonsense"], "kind"),
        (["--jobs", 0], "jobs"),
        (["--seed", -1], "seed"),
        (["--sensor", "nonsense"], "sensor"),
    ],
)
def test_what_cannot_be_run_is_refused_by_field_and_nothing_is_written(tmp_path, words, field):
    answer = called("--out", tmp_path / "report", *words)
    assert answer.exit_code == 2
    assert answer.stderr.startswith("tidegate evaluate integrity: ")
    assert field in answer.stderr
    assert not (tmp_path / "report").exists()


def test_the_table_has_a_row_a_case_and_strict_fails_on_errors(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "run_all", lambda chosen, *_rest, **_options: [[wrong(case)] for case in chosen])
    words = ["--out", tmp_path, "--kind", "sheet laid over half", "--kind", "honest", "--sensor", "locking"]
    answer = called(*words)
    assert answer.exit_code == 0, answer.output
    rows = list(csv.DictReader((tmp_path / "integrity_locking.csv").read_text().splitlines()))
    assert {row["kind"] for row in rows} == {
        "honest",
        "sheet laid over half",
        "sheet laid over half while a marker is hidden",
    }
    assert {row["largest error [mm]"] for row in rows} == {"2.0"}
    assert called(*words, "--strict").exit_code == 1


def test_in_turn_each_case_has_one_volunteer_and_the_next_sensor_the_other(tmp_path, monkeypatch):
    tried = []

    def run(volunteer, case):
        tried.append((case.size, volunteer.number))
        return wrong(case)

    monkeypatch.setattr(bench, "ProcessPoolExecutor", lambda _jobs, **_options: ThreadPoolExecutor(1))
    monkeypatch.setattr(bench, "learn", lambda number, _seed, **pose: SimpleNamespace(number=number, **pose))
    monkeypatch.setattr(bench, "run", run)
    words = ["--out", tmp_path, "--kind", "marker hidden, ", "--jobs", 1]
    assert called(*words, "--in-turn").exit_code == 0
    assert tried == [("0.7 s", 3), ("3 s", 6), ("0.7 s", 6), ("3 s", 3)]
    tried.clear()
    assert called(*words).exit_code == 0
    assert len(tried) == 8


@pytest.mark.slow
def test_its_workers_end_with_a_command_that_is_killed(tmp_path):
    words = [sys.executable, "-m", "service.cli", "evaluate", "integrity", "--kind", "honest, regular", "--jobs", "1"]
    command = subprocess.Popen([*words, "--out", str(tmp_path)], cwd=ROOT, stderr=subprocess.DEVNULL)
    try:
        eventually(lambda: workers_of(command.pid))
        (worker, *_) = workers_of(command.pid)
    finally:
        command.kill()
        command.wait()
    eventually(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE)


def workers_of(parent: int) -> list[psutil.Process]:
    found = psutil.Process(parent).children(recursive=True)
    return [one for one in found if "spawn_main" in " ".join(one.cmdline())]
