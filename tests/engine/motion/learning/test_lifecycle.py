"""What becomes of the trainer's job: the table is whole, and a person's training is never dropped for the engine's."""

import itertools

import pytest

from engine.core.errors import CommandRefusedError
from engine.motion.learning.lifecycle import JOBS, Job, JobEvent, next_job

REFUSED = {
    *((job, event) for job in (Job.RUNS, Job.REFITS, Job.DROPPED) for event in (JobEvent.START, JobEvent.REFIT)),
    (Job.RUNS, JobEvent.RETRAIN),
    (Job.NONE, JobEvent.END),
}


@pytest.mark.parametrize(("job", "event"), list(itertools.product(Job, JobEvent)), ids=str)
def test_what_is_not_in_the_table_is_refused(job, event):
    if (job, event) in REFUSED:
        with pytest.raises(CommandRefusedError, match="being fitted already"):
            next_job(job, event)
    else:
        assert next_job(job, event) is JOBS[job, event]


def test_a_job_of_a_person_stands_and_a_refit_gives_way_to_it():
    assert next_job(Job.REFITS, JobEvent.RETRAIN) is Job.DROPPED


def test_nothing_survives_a_disconnected_camera_and_every_job_ends():
    for job in Job:
        assert next_job(job, JobEvent.LOSE) is (Job.NONE if job is Job.NONE else Job.DROPPED)
    assert {after for (_, event), after in JOBS.items() if event is JobEvent.END} == {Job.NONE}
