"""The evaluation's runs on a cluster: measurements of one machine, recordings that are complete are used again."""

import subprocess
import sys

from tests.support.cluster.processes import started_cluster
from tests.support.evaluation.small_bench import files_under

PROGRAM = """
import sys
from functools import partial
from pathlib import Path

from lab.evaluation.runs.bench import run_bench
from service.cli.cluster.options import scheduler_options
from lab.commands.evaluate.on_cluster import evaluate_on_cluster
from tests.support.evaluation.small_bench import SETTINGS, small_run

work, address, *files = sys.argv[1:]
do_all = None
if address != "here":
    do_all = partial(evaluate_on_cluster, scheduler_options(address, *map(Path, files)))
plan = [small_run("D01"), small_run("D02", seed=6)]
doing = {}
report = lambda progress: doing.setdefault(progress.run, []).append(progress.doing)
scored = run_bench(plan, Path(work), jobs=1, report=report, settings=SETTINGS, do_all=do_all)
for run in plan:
    print(run.name, *dict.fromkeys(doing[run.name]))
"""


def bench(work, *options):
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM, str(work), *map(str, options)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_runs_of_a_cluster_are_those_of_one_machine_and_recordings_are_used_again(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    bench(here, "here")
    with started_cluster(tmp_path / "cluster", "one", "two") as cluster:
        options = (cluster.address, cluster.authority, cluster.client.cert, cluster.client.key)
        assert bench(there, *options) == ["D01 making measuring done", "D02 making measuring done"]
        assert files_under(there) == files_under(here)
        for name in files_under(here):
            if (here / name).is_file():
                assert (there / name).read_bytes() == (here / name).read_bytes(), name
        made = (there / "D02" / "recording.oni").stat()
        (there / "D02" / "measured.json").unlink()
        assert bench(there, *options) == ["D01 done", "D02 measuring done"]
        again = (there / "D02" / "recording.oni").stat()
    assert (again.st_ino, again.st_mtime_ns) == (made.st_ino, made.st_mtime_ns)
    assert files_under(there) == files_under(here)
