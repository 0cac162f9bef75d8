"""A part of `make test` runs what failed once more, alone, and no more than that."""

import re
import subprocess
import sys

import pytest

from tests.support import part
from tests.support.repository import ROOT

PLUGIN = "-p tests.support.part -p tests.support.timings -p no:cacheprovider"
BROKEN = "def test_broken_{number}():\n    assert False\n\n"
UNSTEADY = """from pathlib import Path

def test_passes_the_second_time():
    seen = Path("seen")
    was_there = seen.exists()
    seen.touch()
    assert was_there

"""
GREEN = "def test_green():\n    assert True\n\n"

WAITS = re.compile(r"\beventually\(|\bsubprocess\b|MonotonicClock|time\.monotonic|\.wait\(\d|timeout=\d")
"""What a test waits for, or measures, in seconds."""


def test_what_runs_behind_starts_no_program_and_waits_for_no_deadline():
    """It gets next to nothing of a core for as long as anything in front wants it."""
    command = ["make", "--no-print-directory", "--dry-run", "tests-behind"]
    line = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    behind = re.findall(r"\S+/test_\w+\.py", line)
    assert len(behind) > 80
    assert [path for path in behind if WAITS.search((ROOT / path).read_text(encoding="utf-8"))] == []


@pytest.fixture
def run(tmp_path):
    def run(source):
        (tmp_path / "test_it.py").write_text(source)
        (tmp_path / "pytest.ini").write_text(f"[pytest]\naddopts = -q {PLUGIN}\npythonpath = {ROOT}\n")
        environment = {"PYTHONPATH": str(ROOT), "PATH": "", "PYTHONDONTWRITEBYTECODE": "1"}
        environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # none is used, and their import takes a second
        command = [sys.executable, "-m", "tests.support.part", "some", "test_it.py"]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    return run


def unsteady(tmp_path):
    path = tmp_path / part.UNSTEADY
    return path.read_text().splitlines() if path.exists() else []


def test_a_green_part_names_nothing(run, tmp_path):
    assert run(GREEN).returncode == 0
    assert unsteady(tmp_path) == []


def test_a_test_that_passes_alone_is_named_and_the_part_passes(run, tmp_path):
    outcome = run(GREEN + UNSTEADY)
    assert outcome.returncode == 0, outcome.stdout
    assert "some: 1 failed and run once more, alone" in outcome.stdout
    assert unsteady(tmp_path) == ["test_it.py::test_passes_the_second_time"]


def test_a_test_that_fails_again_fails_the_part(run, tmp_path):
    assert run(GREEN + UNSTEADY + BROKEN.format(number=1)).returncode == part.TESTS_FAILED
    assert unsteady(tmp_path) == []


def test_many_failures_are_not_run_again(run, tmp_path):
    fickle = "".join(UNSTEADY.replace("second_time", f"time_{number}") for number in range(part.MOST + 1))
    outcome = run(fickle.replace('Path("seen")', 'Path(__import__("sys")._getframe().f_code.co_name)'))
    assert outcome.returncode == part.TESTS_FAILED
    assert "once more" not in outcome.stdout


def test_a_part_whose_tests_cannot_be_read_fails(run, tmp_path):
    assert run("import nothing_of_this_name\n").returncode not in {0, part.TESTS_FAILED}


def test_a_skipped_test_is_not_among_those_that_ran(run, tmp_path):
    skipped = "import pytest\n\n@pytest.mark.skip\ndef test_skipped():\n    pass\n\n"
    late = "def test_skips_itself():\n    pytest.skip('later')\n\n"
    assert run(skipped + late + GREEN).returncode == 0
    lines = (tmp_path / part.BUILD / "timings" / "some.tsv").read_text().splitlines()
    assert [line.split("\t")[2] for line in lines] == ["test_it.py::test_green"]
