"""Training jobs in real processes that are killed, stopped, out of memory, or left behind by their engine."""

import json
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from engine.core.errors import ModelError, TrainingFailedError, TrainingRefusedError
from engine.core.learning_status import LearningEventKind
from engine.motion.training_process.__main__ import NICENESS
from engine.motion.training_process.process_trainer import ProcessTrainer
from tests.support.motion.training_frames import FEWER, Patient
from tests.support.motion.training_jobs import (
    Held,
    Killed,
    OutOfMemory,
    Refused,
    Returned,
    StartedBy,
    Unanswerable,
    is_running,
)
from tests.support.waiting import PATIENCE_S, eventually


@pytest.fixture(scope="module")
def trainer():
    made = ProcessTrainer()
    assert outcome(made, Returned(1)) == 1
    yield made
    made.close()


@pytest.fixture
def own():
    """A trainer with a process of its own, which a test may kill."""
    made = ProcessTrainer()
    assert outcome(made, Returned(1)) == 1
    yield made
    made.close()


def outcome(trainer, job):
    trainer.start(job)
    assert trainer.is_busy
    return collected(trainer)


def collected(trainer):
    assert trainer.wait(PATIENCE_S)
    found = trainer.collect()
    assert not trainer.is_busy
    assert trainer.collect() is None
    return found


def arrays_of(active):
    model, basis = active.model, active.basis
    parts = (model.mean_mm, model.components, model.eigenvalues_mm2, model.known, model.surface_mm, model.scores_mm)
    parts += (basis.points, basis.stiffness, basis.known_gram, active.regions.mean_mm, active.regions.modes)
    return (*parts, active.seen_weights.others, active.node_mean_mm, active.node_modes, np.array(model.noise_mm))


def test_a_model_of_another_process_is_the_same_to_the_last_bit(trainer):
    here, there = Patient(FEWER), Patient(FEWER, trainer=trainer)
    here.learn()
    there.see_until(lambda: trainer.is_busy)
    assert trainer.wait(PATIENCE_S)
    there.learn()
    assert len(arrays_of(here.learner.active)) == len(arrays_of(there.learner.active))
    for ours, theirs in zip(arrays_of(here.learner.active), arrays_of(there.learner.active), strict=True):
        assert ours.dtype == theirs.dtype
        assert np.array_equal(ours, theirs)
        assert not theirs.flags.writeable or theirs.ndim == 0
    assert here.learner.active.model.provenance == there.learner.active.model.provenance


def test_a_reference_is_transferred_as_in_this_process(trainer):
    figures = []
    for runs in (None, trainer):
        patient = Patient(FEWER)
        patient.learn()
        patient.see()
        patient.learner.set_reference()
        patient.see()
        if runs is not None:
            patient.learner.models._trainer = runs
        patient.learner.retrain()
        patient.see_until(lambda patient=patient: patient.learner.models._trainer.is_busy or len(models(patient)) == 2)
        if runs is not None:
            assert runs.wait(PATIENCE_S)
        patient.see_until(lambda patient=patient: len(models(patient)) == 2)
        figures.append(models(patient)[1].figures)
    assert figures[0] == figures[1]
    assert "correction_mm" in figures[0]


def models(patient):
    return patient.reported(LearningEventKind.SWAPPED)


def test_a_refusal_comes_back_as_it_was_raised(trainer):
    refusal = outcome(trainer, Refused())
    assert type(refusal) is TrainingRefusedError
    assert (refusal.field, refusal.value, refusal.bound) == ("training.shift_mm", "9.9", "at most 3")
    assert str(refusal) == str(TrainingRefusedError("training.shift_mm", "9.9", "at most 3", "train again"))


@pytest.mark.parametrize(
    ("job", "text"),
    [
        (Killed(), r"was killed \(signal 9\)"),
        (Killed(signal.SIGSEGV), r"was killed \(signal 11\)"),
        (OutOfMemory(), "not enough memory"),
        (Unanswerable(), r"failed \(status 1\)"),
        (Returned(value=None), None),
    ],
    ids=["killed", "crashed", "out of memory", "without an answer", "fine"],
)
def test_a_job_that_dies_is_a_refusal_and_the_next_one_runs(trainer, job, text):
    before = trainer.process.process_id
    if text is not None:
        failure = outcome(trainer, job)
        assert type(failure) is TrainingFailedError
        assert failure.code == "training_failed"
        assert re.search(text, str(failure))
    assert outcome(trainer, Returned(7)) == 7
    assert trainer.process.process_id == before


def test_a_job_that_hangs_is_killed_and_the_next_one_runs(own, tmp_path):
    process, job = own.process, Held(tmp_path / "held", is_stopped=True)
    process.patience_s = 0.5
    failure = outcome(own, job)
    assert "took longer than 0.5 s" in str(failure)
    assert not is_running(job.process_id())
    assert outcome(own, Returned(2)) == 2
    assert own.process is process


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_a_training_process_that_dies_or_stops_is_replaced_for_the_next_job(own, number):
    before = own.process
    before.start_s = 0.5
    os.kill(before.process_id, number)
    failure = outcome(own, Returned(3))
    assert "has ended or hangs" in str(failure)
    assert not is_running(before.process_id)
    assert outcome(own, Returned(4)) == 4
    assert own.process is not before


def test_a_training_process_that_dies_during_a_job_takes_the_job_with_it(own, tmp_path):
    job = Held(tmp_path / "held")
    own.start(job)
    working = job.process_id()
    os.kill(own.process.process_id, signal.SIGKILL)
    assert type(collected(own)) is TrainingFailedError
    eventually(lambda: not is_running(working))
    assert outcome(own, Returned(5)) == 5


def test_a_second_job_is_refused_while_one_runs(own, tmp_path):
    job = Held(tmp_path / "held")
    own.start(job)
    with pytest.raises(ModelError, match="already"):
        own.start(Returned(1))
    job.process_id()
    job.marker.unlink()
    assert collected(own) == "released"


def test_a_training_process_without_jobs_is_ended_and_started_again_for_the_next():
    trainer = ProcessTrainer(idle_s=0.01)
    first = outcome(trainer, StartedBy())
    eventually(lambda: not is_running(first))
    assert outcome(trainer, StartedBy()) != first
    trainer.close()


def test_closing_ends_a_job_and_its_answer_never_comes(tmp_path):
    trainer, job = ProcessTrainer(), Held(tmp_path / "held")
    trainer.start(job)
    working, process_id = job.process_id(), trainer.process.process_id
    trainer.close()
    eventually(lambda: not is_running(working))
    assert not is_running(process_id)
    assert isinstance(trainer.collect(), TrainingFailedError)


def test_a_killed_training_leaves_the_model_and_the_next_request_is_answered(own):
    """By the learner: one refusal, the same model, and then a new one."""
    patient = Patient(FEWER)
    patient.learn()
    first = patient.learner.active
    patient.learner.models._trainer = own
    patient.learner.retrain()
    os.kill(own.process.process_id, signal.SIGKILL)
    patient.see_until(lambda: own.is_busy)
    assert own.wait(PATIENCE_S)
    patient.see()
    assert [notice.figures["code"] for notice in patient.reported(LearningEventKind.REFUSED)] == ["training_failed"]
    assert patient.learner.active is first
    assert "train again" in patient.learner.models.progress.note
    patient.learner.retrain()
    patient.see_until(lambda: own.is_busy)
    assert own.wait(PATIENCE_S)
    patient.see()
    assert patient.learner.active is not first
    assert len(patient.reported(LearningEventKind.REFUSED)) == 1


def test_the_jobs_of_an_engine_end_with_it_and_hold_none_of_its_files(tmp_path):
    """The engine is killed while a job runs; the training process was forked, and a job has the lowest standing."""
    job = Held(tmp_path / "held")
    program = [sys.executable, "-m", "tests.support.motion.training_program", str(job.marker)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as engine:
        seen = json.loads(engine.stdout.readline())
        working = job.process_id()
        engine.kill()
    for process_id in (seen["server"], working):
        eventually(lambda process_id=process_id: not is_running(process_id))
    described = seen["job"]
    assert described["threads"] == 1
    assert described["oom"] == 1000
    assert described["niceness"] >= NICENESS
    files = {number: target for number, target in described["files"].items() if int(number) > 2}
    assert not set(seen["inherited"]) & {int(number) for number, target in files.items() if target.startswith("pipe")}
    assert sorted(target.partition(":")[0] for target in files.values() if "/proc/" not in target) == [
        "/memfd",
        "/memfd",
        "socket",
    ]
