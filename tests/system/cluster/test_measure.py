"""`tidegate measure --scheduler`: the files of one machine, and nothing else, whoever is killed, refused or stopped."""

import csv
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.cluster.processes import OTHER_VERSION, started_cluster
from tests.support.waiting import eventually

RESULTS = ("breathing.csv", "model.npz", "motion.csv", "motion_summary.json", "regions.npz")
COMMAND = [sys.executable, "-W", "ignore", "-m", "service.cli"]


def begun(arguments, folder):
    return subprocess.Popen(
        [*COMMAND, "measure", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder
    )


def ended(process):
    said, _ = process.communicate(timeout=240)
    return process.returncode, " ".join(said.decode().split())


def measure(arguments, folder):
    return ended(begun(arguments, folder))


@pytest.fixture(scope="module")
def here(regular_volunteer, tmp_path_factory):
    """What one machine makes of the recording."""
    folder = tmp_path_factory.mktemp("here")
    code, said = measure([regular_volunteer / "recording.oni", "--out", "out"], folder)
    assert code == 0, said
    return {name: (folder / "out" / name).read_bytes() for name in RESULTS}


@pytest.fixture
def recordings(regular_volunteer, tmp_path):
    """Three folders with the same recording, by relative path."""
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        for file in ("recording.oni", "calibration.json"):
            (tmp_path / name / file).symlink_to(regular_volunteer / file)
    return [Path(name) / "recording.oni" for name in ("a", "b", "c")]


def drafts(out):
    """The folders in which workers are writing a table now."""
    return list(out.glob(".cluster-*/*/motion.csv.partial"))


def rows(out):
    with (out / "summary.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_worker_is_killed_in_the_middle_and_every_file_is_that_of_one_machine(here, recordings, tmp_path):
    out = tmp_path / "out"
    with started_cluster(tmp_path / "cluster", "one", "two") as cluster:
        running = begun([*recordings, "--out", "out", *cluster.options], tmp_path)
        eventually(lambda: len(drafts(out)) == 2 or running.poll() is not None, within_s=120)
        assert len(drafts(out)) == 2, "both workers measure"
        cluster.kill("one")
        code, said = ended(running)
        assert cluster.is_running("two")
    assert code == 0, said
    found = rows(out)
    assert [row["file"] for row in found] == [str(path) for path in recordings]
    assert {row["error"] for row in found} == {""}
    for row in found:
        for name in RESULTS:
            assert (tmp_path / row["folder"] / name).read_bytes() == here[name], name
    assert sorted(path.name for path in out.iterdir()) == [
        *("a-recording", "b-recording", "c-recording", "summary.csv")
    ]
    assert all(sorted(path.name for path in (tmp_path / row["folder"]).iterdir()) == list(RESULTS) for row in found)


def test_control_c_cancels_the_tasks_and_leaves_nothing(recordings, tmp_path, interruptible):
    out = tmp_path / "out"
    with started_cluster(tmp_path / "cluster", "one") as cluster:
        running = begun([*recordings, "--out", "out", *cluster.options], tmp_path)
        eventually(lambda: drafts(out) or running.poll() is not None, within_s=120)
        running.send_signal(signal.SIGINT)
        code, said = ended(running)
        assert code not in {0, 2}, said
        assert "Traceback" not in said
        assert list(out.rglob("*")) == []
        # The worker is free again: it does the next run.
        (tmp_path / "junk.oni").write_bytes(b"none")
        shutil.copy(tmp_path / recordings[0].parent / "calibration.json", tmp_path)
        code, said = measure(["junk.oni", "--out", "other", *cluster.options], tmp_path)
    assert code == 2
    assert "junk.oni" in said


def test_a_worker_of_another_version_is_refused_by_name_before_anything_is_done(recordings, tmp_path):
    with started_cluster(tmp_path / "cluster", "one") as cluster:
        cluster.add_worker("old", before=OTHER_VERSION)
        code, said = measure([*recordings, "--out", "out", *cluster.options], tmp_path)
    assert code == 2
    assert "has Tidegate 0.1.0, this client has" in said
    assert list((tmp_path / "out").rglob("*")) == []


def test_a_worker_of_another_version_that_joins_later_is_sent_away_and_the_run_completes(recordings, tmp_path):
    out = tmp_path / "out"
    with started_cluster(tmp_path / "cluster", "one") as cluster:
        running = begun([*recordings, "--out", "out", *cluster.options], tmp_path)
        eventually(lambda: drafts(out) or running.poll() is not None, within_s=120)
        cluster.add_worker("old", before=OTHER_VERSION)
        code, said = ended(running)
        eventually(lambda: not cluster.is_running("old"))
    assert code == 0, said
    assert said.count("Refused: worker") == 1
    assert [row["error"] for row in rows(out)] == [""] * 3


def test_a_worker_with_two_threads_is_refused(recordings, tmp_path):
    with started_cluster(tmp_path / "cluster") as cluster:
        cluster.add_worker("two-threads", threads=2)
        code, said = measure([*recordings, "--out", "out", *cluster.options], tmp_path)
    assert code == 2
    assert "has 2 threads; start it with --nthreads 1" in said


def test_a_worker_that_does_not_find_a_file_names_itself_and_the_path(recordings, tmp_path):
    with started_cluster(tmp_path / "cluster", "one") as cluster:
        absent = tmp_path / "absent" / "recording.oni"
        code, _ = measure([recordings[0], absent, "--out", "out", *cluster.options], tmp_path)
    assert code == 2
    good, bad = rows(tmp_path / "out")
    assert good["error"] == ""
    assert bad["error"].startswith("worker one on ")
    assert bad["error"].endswith(f"does not find {absent}")


def test_a_scheduler_that_is_lost_ends_the_run_in_one_line(recordings, tmp_path):
    out = tmp_path / "out"
    with started_cluster(tmp_path / "cluster", "one") as cluster:
        running = begun([*recordings, "--out", "out", *cluster.options], tmp_path)
        eventually(lambda: drafts(out) or running.poll() is not None, within_s=120)
        cluster.kill_scheduler()
        code, said = ended(running)
    assert code == 2
    assert "the scheduler was lost" in said
    assert "Traceback" not in said
    assert list(out.rglob("*")) == []


def test_a_client_with_a_certificate_of_another_authority_does_not_get_in(recordings, tmp_path):
    with started_cluster(tmp_path / "cluster") as cluster, started_cluster(tmp_path / "other") as other:
        options = ["--scheduler", cluster.address, *other.options[2:]]
        code, said = measure([*recordings, "--out", "out", *options], tmp_path)
    assert code == 2
    assert f"the scheduler {cluster.address} did not answer" in said
