"""A training set is complete by time and cycles, says how far it is, and is refused where it teaches nothing."""

import math
import threading
import weakref
from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, ModelError, TrainingRefusedError
from engine.motion.breathing import excursion_mm, noise_mm, speed_mm_s
from engine.motion.learning import trainer as training
from engine.motion.learning.trainer import TRAINING_BOUNDS, BackgroundTrainer, InlineTrainer, TrainingSettings
from engine.motion.learning.training_quality import find_outliers, refuse_breathless, refuse_disturbed, refuse_moving
from engine.motion.learning.training_set import TrainingSet
from tests.support.motion import training_frames
from tests.support.motion.training_frames import BELLY, FEW, FRAME_US, Patient, breath, vertices

pytestmark = pytest.mark.slow

SECOND = round(1e6 / FRAME_US)


def gather(indices, settings=FEW, **surface):
    filled = TrainingSet(settings, vertices)
    for index in indices:
        filled.add(training_frames.frame(index, **surface))
    return filled


def refusal_of(patient, **surface):
    """What the patient's first training is refused for."""
    patient.see_until(lambda: patient.reported("refused"), **surface)
    return patient.reported("refused")[0]


# -- completeness -------------------------------------------------------------------------------------------------


def test_a_set_is_complete_with_frames_seconds_and_cycles_and_not_before():
    wanted = replace(FEW, min_frames=60, min_seconds=4.0, min_cycles=2)
    filled = TrainingSet(wanted, vertices)
    for index in range(1000):
        filled.add(training_frames.frame(index))
        if filled.is_complete:
            break
    assert (filled.cycles, len(filled.frames) >= 60) == (2, True)
    assert 8.0 < filled.seconds < wanted.max_seconds


def test_waiting_ends_when_cycles_never_come_and_the_progress_states_it():
    wanted = replace(FEW, max_seconds=6.0, min_cycles=3)
    filled = gather(range(5 * SECOND), wanted)
    assert not filled.is_complete
    assert "3 are needed" in filled.progress.note
    assert gather(range(7 * SECOND), wanted).is_complete


def test_a_long_set_is_thinned_evenly_and_keeps_its_signal_of_every_frame():
    filled = gather(range(260), replace(FEW, min_frames=30, max_frames=64))
    times = np.diff([frame.timestamp_us for frame in filled.frames])
    assert len(filled.frames) <= 64
    assert len(set(times.tolist())) == 1
    assert len(filled.signals.seconds) == 260
    assert [filled.signals.seconds[i] for i in filled.signals.kept] == [f.timestamp_us / 1e6 for f in filled.frames]


@pytest.mark.parametrize("jump", [4 * SECOND, -50], ids=["gap", "clock went back"])
def test_a_gap_begins_the_set_anew(jump):
    filled = gather([*range(100, 150), 149 + jump, 150 + jump])
    assert len(filled.frames) == 2
    assert filled.seconds < 0.1


def test_progress_reports_amplitude_and_shift_of_the_patient():
    still = gather(range(6 * SECOND)).progress
    assert still.amplitude_mm == pytest.approx(5.4, abs=0.8)
    assert still.shift_mm < 1.0
    moving = TrainingSet(FEW, vertices)
    for index in range(6 * SECOND):
        moving.add(training_frames.frame(index, shift_mm=(0.1 * index, 0.0, 0.0)))
    assert moving.progress.shift_mm > 8.0
    assert gather(range(3)).progress.amplitude_mm is None


# -- what teaches nothing -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("excursion", "noise"), [((0.0, 0.0), True), ((0.0, 0.0), False)], ids=["a doll", "a plate without noise"]
)
def test_a_doll_is_refused_with_the_amplitude_it_lacks(excursion, noise):
    notice = refusal_of(Patient(), excursion=excursion, noise=noise)
    assert notice.figures["field"] == "training.amplitude_mm"
    assert float(notice.figures["value"]) < 0.2
    assert notice.figures["bound"].startswith("at least 0.6")
    assert "no breathing was measured" in notice.detail


def test_a_signal_no_deeper_than_its_noise_is_no_breath():
    signals = gather(range(6 * SECOND)).signals
    random = np.random.default_rng(3)
    noisy = replace(signals, motion_mm=random.normal(0.0, 4.0, signals.motion_mm.shape))
    with pytest.raises(TrainingRefusedError, match="amplitude_mm"):
        refuse_breathless(noisy, FEW)
    amplitude, noise = refuse_breathless(signals, FEW)
    assert amplitude > 20.0 * noise


def test_a_shallow_breath_still_teaches():
    patient = Patient()
    patient.learn(excursion=lambda index: breath(index * FRAME_US / 1e6, depth_mm=2.0))
    assert patient.learner.active.model.provenance.quality.amplitude_mm == pytest.approx(1.1, abs=0.3)


@pytest.mark.parametrize(
    ("shift_mm", "field"),
    [((0.12, 0.0, 0.0), "training.shift_mm"), ((0.0, -0.12, 0.0), "training.shift_mm")],
    ids=["across", "along"],
)
def test_a_patient_who_slides_is_refused(shift_mm, field):
    notice = refusal_of(Patient(), shift_mm=lambda index: tuple(index * mm for mm in shift_mm))
    assert notice.figures["field"] == field
    assert "lies still" in notice.detail


def test_a_patient_who_turns_is_refused():
    across = np.linspace(-40.0, 40.0, BELLY.shape[1])
    notice = refusal_of(Patient(), shape=lambda index: across * index / 150.0)
    assert notice.figures["field"] == "training.tilt_deg"


def test_breathing_itself_is_no_movement():
    for count in (130, 150, 170, 200, 240):
        shift_mm, tilt_deg = refuse_moving(gather(range(count)).frames, vertices, FEW, 5.4)
        assert shift_mm < 1.0
        assert tilt_deg < 1.0


def test_a_hand_now_and_then_is_left_out_of_the_model_and_counted():
    clean, handled = Patient(), Patient()
    hand = np.where(BELLY > 0.8, -90.0, 0.0)
    learned = clean.learn()
    model = handled.learn(shape=lambda index: hand if 40 <= index < 60 else None)
    assert model.provenance.quality.outlier_share == pytest.approx(20 / 170, abs=0.05)
    assert np.abs(model.mean_mm - learned.mean_mm).max() < 2.0


def test_a_set_with_many_hands_is_refused():
    hand = np.where(BELLY > 0.8, -90.0, 0.0)
    notice = refusal_of(Patient(), shape=lambda index: hand if index % 120 >= 80 else None)
    assert notice.figures["field"] == "training.outlier_share"
    assert float(notice.figures["value"]) > 0.2


def test_a_cough_is_an_outlier_and_breath_is_not():
    filled = TrainingSet(FEW, vertices)
    for index in range(6 * SECOND):
        chest, belly = breath(index * FRAME_US / 1e6)
        cough = 25.0 * math.exp(-(((index - 100) / 4.0) ** 2))
        filled.add(training_frames.frame(index, excursion=(chest + cough, belly + 2.0 * cough)))
    outliers = find_outliers(filled.frames, filled.signals, 10.0)
    assert outliers[90:110].any()
    assert not outliers[:80].any()
    assert not outliers[120:].any()
    assert refuse_disturbed(outliers, replace(FEW, max_outlier_share=0.2)) > 0.0
    with pytest.raises(TrainingRefusedError, match="coughed"):
        refuse_disturbed(outliers, replace(FEW, max_outlier_share=0.0))


def test_after_a_refusal_without_a_model_gathering_begins_anew_and_states_why():
    patient = Patient()
    refusal_of(patient, excursion=(0.0, 0.0))
    assert patient.learner.models.is_gathering
    assert "no breathing was measured" in patient.learner.models.progress.note
    patient.learn()
    assert patient.learner.active is not None
    assert patient.learner.models.progress is None


# -- settings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRAINING_BOUNDS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e9, True, "3"], ids=str)
def test_each_setting_is_refused_beyond_its_bound_by_name(name, value):
    with pytest.raises(InvalidValueError) as refusal:
        TrainingSettings(**{name: value})
    assert refusal.value.field == name


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"min_seconds": 20.0, "max_seconds": 10.0}, "max_seconds"),
        ({"min_frames": 100, "max_frames": 199}, "max_frames"),
        ({"retrain_interval_s": 5.0}, "retrain_interval_s"),
    ],
    ids=str,
)
def test_settings_that_cannot_be_met_are_refused(settings, field):
    with pytest.raises(InvalidValueError) as refusal:
        TrainingSettings(**settings)
    assert refusal.value.field == field


# -- signals and trainers -------------------------------------------------------------------------------------------


def test_excursion_noise_and_speed_are_those_of_a_constructed_breath():
    seconds = np.arange(600) / 30.0
    signal = 5.0 * np.sin(2.0 * np.pi * seconds / 4.0)
    noisy = signal + np.random.default_rng(0).normal(0.0, 0.3, len(signal))
    assert excursion_mm(noisy, seconds) == pytest.approx(2 * 5.0 * math.sin(0.45 * math.pi), rel=0.05)
    assert noise_mm(noisy) == pytest.approx(0.3, rel=0.15)
    assert speed_mm_s(signal, seconds).max() == pytest.approx(2.0 * np.pi * 5.0 / 4.0, rel=0.05)
    assert (excursion_mm(signal[:2], seconds[:2]), noise_mm(signal[:2])) == (0.0, 0.0)


@pytest.mark.parametrize("kind", [InlineTrainer, BackgroundTrainer])
def test_whatever_goes_wrong_in_a_job_comes_back_as_a_refusal_and_the_trainer_is_free_again(kind):
    trainer = kind()
    for error in (ModelError("no"), KeyError("x"), ZeroDivisionError("y")):
        done = threading.Event()

        def fail(error=error, done=done):
            done.set()
            raise error

        trainer.start(fail)
        assert done.wait(10.0)
        outcome = None
        while outcome is None:
            outcome = trainer.collect()
        assert isinstance(outcome, ModelError)
        assert not trainer.is_busy


def test_freed_memory_is_given_back_after_every_fit_and_behind_its_result(monkeypatch):
    """The model does not wait for it, and the job's frames are released by then."""
    frames, let_go, given = np.zeros(3), threading.Event(), threading.Semaphore(0)
    alive = weakref.ref(frames)

    def give_back():
        assert let_go.wait(10.0)
        if alive() is None:
            given.release()

    monkeypatch.setattr(training, "give_freed_memory_back", give_back)
    trainer = BackgroundTrainer()
    trainer.start(lambda frames=frames: float(frames.sum()))
    del frames
    while trainer.collect() is None:
        pass
    let_go.set()
    assert given.acquire(timeout=10.0)
