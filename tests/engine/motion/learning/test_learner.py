"""Models take over between two frames: no step, no drift of the reference, never while armed, always reported."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import CommandRefusedError, ModelMismatchError
from engine.core.learning_status import LearningEventKind
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.position_fit import rigid_between
from engine.motion.learning.reference_transfer import compare_models
from engine.motion.learning.trainer import BackgroundTrainer
from tests.support.motion import training_frames
from tests.support.motion.held_trainer import HeldTrainer
from tests.support.motion.training_frames import (
    BELLY,
    CHEST,
    FEWER,
    FRAME_US,
    QUICK_S,
    SHA256,
    STAGES,
    Patient,
    breath,
    explain,
    vertices,
)

pytestmark = pytest.mark.slow

STEADY = (1.0, 2.5)
"""A steady phantom's excursion; learning needs breath, measuring the step does not."""


@pytest.fixture(scope="module")
def learned():
    patient = Patient()
    return patient.learn()


@pytest.fixture
def patient(learned):
    """A patient who is measured; zero is the frame at rest."""
    patient = Patient()
    patient.learner.activate(learned)
    patient.learner.set_reference()
    patient.see(excursion=(0.0, 0.0))
    return patient


def retrain(patient, **kwargs):
    """Learn again, to the swap; returns the motion just before and just after of the same surface."""
    before = patient.learner.active
    patient.learner.retrain(**kwargs)
    patient.see_until(lambda: patient.learner.active is not before)


def hurried(learned):
    """A patient who breathes quickly and is measured; zero is the frame at rest."""
    patient = Patient(FEWER)
    patient.learner.activate(learned)
    patient.see(excursion=(0.0, 0.0))
    return patient


def see_quick_breath(patient, **surface):
    """Show one frame of quick breathing; learn again as soon as nothing is being learned."""
    if not patient.learner.models.is_gathering:
        patient.learner.retrain()
    patient.see(excursion=breath(patient.index * FRAME_US / 1e6, period_s=QUICK_S), **surface)


def steady_mm(patient, frames=30):
    """Mean motion of every region of a steady surface; volume last."""
    return np.mean([patient.measured(training_frames.frame(9000 + i, excursion=STEADY)) for i in range(frames)], axis=0)


# -- zero and sign --------------------------------------------------------------------------------------------------


def test_after_a_first_training_a_person_sets_the_reference():
    """Motion is shown from the first measured frame meanwhile, and that is no reference."""
    patient = Patient()
    patient.learn()
    assert abs(patient.see()[patient.whole]) < 1.0
    assert not patient.learner.status.has_reference
    assert [notice.kind for notice in patient.notices][-2:] == [
        LearningEventKind.SWAPPED,
        LearningEventKind.ZERO_NEEDED,
    ]
    patient.learner.retrain()
    patient.see_until(lambda: len(patient.reported(LearningEventKind.SWAPPED)) == 2)
    assert not patient.learner.status.has_reference, "a model that takes a reference over makes none"
    patient.learner.set_reference()
    patient.see(excursion=(0.0, 0.0))
    assert patient.learner.status.has_reference
    assert patient.measured(training_frames.frame(9000, excursion=(4.0, 10.0)))[patient.whole] > 4.0


def test_a_swap_steps_no_region_and_no_volume_of_a_steady_surface(patient):
    before = steady_mm(patient)
    retrain(patient)
    step = np.abs(steady_mm(patient) - before)
    assert step[patient.whole] < 0.05
    assert step[patient.whole : patient.whole + 3].max() < 0.05
    assert step[: patient.whole].max() < 0.15
    assert step[-1] < 0.0005


def test_a_reference_that_is_carried_over_is_the_same_reference_and_one_that_is_set_another(patient):
    assert patient.learner.status.reference_number == 1
    retrain(patient)
    assert patient.learner.status.reference_number == 1
    patient.learner.set_reference()
    patient.see()
    assert patient.learner.status.reference_number == 2
    retrain(patient, keeps_reference=False)
    patient.see()
    assert patient.learner.status.reference_number == 3


def test_without_carrying_over_the_new_model_would_step(patient):
    """The test above proves something only if the two models disagree at all."""
    bowed = replace(patient.learner.active.model, mean_mm=patient.learner.active.model.mean_mm + np.float32(0.3))
    active = STAGES.prepare(bowed)
    frames = [training_frames.frame(i) for i in range(40)]
    other = replace(active, regions=replace(active.regions, mean_mm=active.regions.mean_mm + 0.25))
    carry = compare_models(patient.learner.active, other, frames, explain=explain, vertices=vertices)
    assert carry.whole_mm == pytest.approx(0.25, abs=0.02)
    assert carry.correction_mm == pytest.approx(0.25, abs=0.05)


def test_a_place_unseen_while_the_reference_is_carried_over_is_unseen_in_the_reference(patient):
    before = patient.learner.active
    seen_then = patient.reference().seen_shares
    assert seen_then.min() == 1.0
    frames = [training_frames.frame(i, hide=np.s_[140:]) for i in range(20)]
    carry = compare_models(before, before, frames, explain=explain, vertices=vertices)
    shares = before.seen_weights.by_region(carry.applied(patient.reference()).seen_shares)
    assert not shares.cells[12:].any()
    assert (shares.cells[:11] == 1.0).all()


def test_a_model_that_sees_everything_half_a_millimetre_deeper_still_moves_nothing(patient):
    """Two models of one patient differ by hundredths; this one by so much that a wrong carry cannot hide."""
    before = steady_mm(patient)

    def deeper(model):
        active = STAGES.prepare(model)
        regions = replace(
            active.regions, mean_mm=active.regions.mean_mm + np.linspace(0.3, 0.6, active.regions.mean_mm.size)
        )
        return replace(active, regions=regions, node_mean_mm=active.node_mean_mm + 0.5)

    models = patient.learner.models
    models.setup = replace(models.setup, stages=replace(STAGES, prepare=deeper))
    retrain(patient)
    figures = patient.reported(LearningEventKind.SWAPPED)[-1].figures
    step = np.abs(steady_mm(patient) - before)
    assert figures["zero_after_mm"] - figures["zero_before_mm"] > 0.4
    assert figures["volume_correction_l"] < -0.01
    assert step[:-1].max() < 0.15
    assert step[patient.whole] < 0.05
    assert step[-1] < 0.001


def test_the_sign_does_not_flip_over_retrainings(patient):
    retrain(patient)
    rest = patient.measured(training_frames.frame(5000, excursion=(0.0, 0.0)))
    deep = patient.measured(training_frames.frame(5001, excursion=(4.0, 10.0)))
    assert deep[patient.whole] - rest[patient.whole] > 4.0


def test_the_reference_does_not_walk_over_twenty_retrainings_of_a_steady_patient(learned):
    patient = hurried(learned)
    before = steady_mm(patient)
    while len(patient.reported(LearningEventKind.SWAPPED)) < 21:
        assert patient.index < 3000
        see_quick_breath(patient)
    after = steady_mm(patient)
    assert np.abs(after - before)[patient.whole : patient.whole + 3].max() < 0.03
    assert np.abs(after - before)[: patient.whole].max() < 0.15
    assert abs(after - before)[-1] < 0.003


def test_the_reference_does_not_follow_a_patient_who_drifts(learned):
    """Ten millimetres away from the camera through retrainings all the way: all of it has to show."""
    patient = hurried(learned)
    while patient.index < 500:
        see_quick_breath(patient, shift_mm=(0.0, 0.0, 0.02 * patient.index))
    assert len(patient.reported(LearningEventKind.SWAPPED)) > 6
    drift_mm = 0.02 * patient.index
    there = [training_frames.frame(9000 + i, excursion=(0.0, 0.0), shift_mm=(0.0, 0.0, drift_mm)) for i in range(30)]
    seen = np.mean([patient.measured(frame) for frame in there], axis=0)
    assert seen[patient.whole] == pytest.approx(-drift_mm, abs=0.15)


def test_a_reference_that_was_set_again_meanwhile_is_the_one_that_is_carried_over(patient):
    first = patient.learner.active
    patient.learner.retrain()
    for _ in range(40):
        patient.see()
    patient.learner.set_reference()
    patient.see(excursion=STEADY)
    patient.see_until(lambda: patient.learner.active is not first)
    assert abs(steady_mm(patient)[patient.whole]) < 0.1


# -- refused swaps --------------------------------------------------------------------------------------------------


def test_a_model_that_disagrees_on_where_the_patient_is_is_refused_and_the_present_one_measures_on(patient):
    shifted = replace(patient.learner.active.model, mean_mm=patient.learner.active.model.mean_mm)
    first = patient.learner.active
    prepare = STAGES.prepare

    def biased(model):
        active = prepare(model)
        return replace(active, regions=replace(active.regions, mean_mm=active.regions.mean_mm + 1.5))

    models = patient.learner.models
    models.setup = replace(models.setup, stages=replace(STAGES, prepare=biased))
    patient.learner.activate(shifted)
    patient.see_until(lambda: patient.reported(LearningEventKind.REFUSED))
    notice = patient.reported(LearningEventKind.REFUSED)[0]
    assert notice.figures["field"] == "carry.correction_mm"
    assert float(notice.figures["value"]) == pytest.approx(1.5, abs=0.1)
    assert notice.figures["bound"] == "at most 1"
    assert patient.learner.active is first
    assert patient.learner.status.has_reference


def test_a_patient_the_present_model_does_not_know_any_more_keeps_no_reference_silently(patient):
    first = patient.learner.active
    patient.learner.retrain()
    other = 25.0 * np.cos(np.linspace(0.0, 9.0 * np.pi, BELLY.shape[1]))
    patient.see_until(lambda: patient.reported(LearningEventKind.REFUSED), shape=other)
    assert patient.reported(LearningEventKind.REFUSED)[0].figures["field"] == "carry.frames"
    assert "without keeping the reference" in patient.learner.models.progress.note
    assert patient.learner.active is first
    patient.learner.retrain(keeps_reference=False)
    patient.see_until(lambda: patient.learner.active is not first, shape=other)
    patient.see(shape=other)
    assert not patient.learner.status.has_reference
    assert patient.reported(LearningEventKind.ZERO_NEEDED)
    patient.learner.set_reference()
    patient.see(shape=other)
    assert patient.learner.status.has_reference


def test_a_refusal_is_shown_for_half_a_minute_and_a_refused_model_leaves_the_present_one(patient):
    first = patient.learner.active
    patient.learner.retrain()
    patient.see_until(lambda: patient.reported(LearningEventKind.REFUSED), excursion=(0.0, 0.0))
    assert "no breathing was measured" in patient.learner.models.progress.note
    assert not patient.learner.models.is_gathering
    patient.index += round(31e6 / FRAME_US)
    patient.see()
    assert patient.learner.models.progress is None
    assert patient.learner.active is first


# -- when a model may take over -------------------------------------------------------------------------------------


def test_a_model_waits_while_the_present_one_is_kept_and_takes_over_when_it_is_not(patient):
    first, generation = patient.learner.active, patient.learner.journal.generation
    patient.learner.keep_model(is_kept=True)
    patient.learner.retrain()
    patient.see_until(lambda: patient.learner.status.is_model_waiting)
    for _ in range(20):
        patient.see()
    assert (patient.learner.active, patient.learner.journal.generation) == (first, generation)
    assert "ready" in patient.learner.models.progress.note
    assert [notice.kind for notice in patient.notices][-1] == LearningEventKind.READY
    patient.learner.keep_model(is_kept=False)
    patient.see()
    assert patient.learner.active is not first
    assert patient.learner.journal.generation == generation + 1
    assert patient.reported(LearningEventKind.SWAPPED)


def test_a_waiting_model_is_applied_on_a_person_s_word(patient):
    with pytest.raises(CommandRefusedError, match="no new model"):
        patient.learner.apply_model()
    first = patient.learner.active
    patient.learner.keep_model(is_kept=True)
    patient.learner.retrain()
    patient.see_until(lambda: patient.learner.status.is_model_waiting)
    patient.learner.apply_model()
    assert patient.learner.active is not first
    assert not patient.learner.status.is_model_waiting


def test_the_first_model_is_not_held_up_by_anything():
    patient = Patient()
    patient.learner.keep_model(is_kept=False)
    patient.learn()
    assert patient.learner.active is not None


def test_models_are_learned_again_at_intervals_and_only_then(learned):
    patient = Patient(replace(FEWER, retrain_interval_s=10.0))
    patient.learner.activate(learned)
    for _ in range(round(30e6 / FRAME_US)):
        patient.see()
    started = [notice.timestamp_us / 1e6 for notice in patient.reported(LearningEventKind.STARTED)]
    swapped = [notice.timestamp_us / 1e6 for notice in patient.reported(LearningEventKind.SWAPPED)]
    assert len(started) == 2
    assert started[0] == pytest.approx(10.0, abs=0.1)
    assert started[1] - swapped[1] == pytest.approx(10.0, abs=0.1)
    idle = Patient()
    idle.learner.activate(learned)
    for _ in range(30):
        idle.see()
        idle.index += 900
    assert not idle.reported(LearningEventKind.STARTED)


def test_an_interval_that_was_refused_is_tried_again_after_another(learned):
    patient = Patient(replace(FEWER, retrain_interval_s=10.0, max_seconds=2.0))
    patient.learner.activate(learned)
    patient.see_until(lambda: len(patient.reported(LearningEventKind.REFUSED)) == 2, excursion=(0.0, 0.0))
    times = [notice.timestamp_us / 1e6 for notice in patient.reported(LearningEventKind.STARTED)]
    assert times[1] - times[0] == pytest.approx(12.0, abs=0.3)


def test_a_newer_model_takes_the_place_of_one_that_waits(patient):
    patient.learner.keep_model(is_kept=True)
    first = patient.learner.active
    for expected in (1, 2):
        patient.learner.retrain()
        patient.see_until(lambda n=expected: len(patient.reported(LearningEventKind.READY)) == n)
    patient.learner.keep_model(is_kept=False)
    patient.see()
    assert patient.learner.active is not first
    assert len(patient.reported(LearningEventKind.SWAPPED)) == 2  # the fixture's own, and this one


def test_frames_are_measured_while_a_model_is_fitted_and_commands_wait(learned):
    patient = Patient(trainer=HeldTrainer())
    trainer = patient.learner.models._trainer
    patient.learner.activate(learned)
    trainer.finish()
    patient.see()
    patient.learner.retrain()
    patient.see_until(lambda: trainer.job is not None)
    first = patient.learner.active
    assert all(patient.see() is not None for _ in range(20))
    assert "fitting" in patient.learner.models.progress.note
    for command in (patient.learner.retrain, lambda: patient.learner.activate(learned)):
        with pytest.raises(CommandRefusedError, match="already"):
            command()
    trainer.finish()
    patient.see()
    assert patient.learner.active is not first


def test_no_frame_waits_for_the_trainer_s_thread(learned):
    """With a real thread whose job cannot end before fifty frames were measured."""
    enough = threading.Event()

    class Gated(BackgroundTrainer):
        def start(self, job):
            def run():
                assert enough.wait(30.0)
                return job()

            super().start(run)

    patient = Patient(trainer=Gated())
    enough.set()
    patient.learner.activate(learned)
    patient.see_until(lambda: patient.learner.active is not None, most=100_000, excursion=(0.0, 0.0))
    first = patient.learner.active
    enough.clear()
    patient.learner.retrain()
    patient.see_until(lambda: patient.learner.models._trainer.is_busy)
    measured = [patient.see() for _ in range(50)]
    assert all(motion is not None for motion in measured)
    assert patient.learner.active is first
    enough.set()
    patient.see_until(lambda: patient.learner.active is not first, most=100_000)
    assert len(patient.reported(LearningEventKind.SWAPPED)) == 2


def test_every_swap_reports_both_references_and_the_correction(patient):
    retrain(patient)
    ready, swapped = (
        patient.reported(LearningEventKind.READY)[0].figures,
        patient.reported(LearningEventKind.SWAPPED)[-1].figures,
    )
    assert ready == swapped
    assert abs(swapped["zero_after_mm"] - swapped["zero_before_mm"]) <= swapped["correction_mm"] + 1e-4
    assert swapped["correction_mm"] < 0.1
    assert {"explained_share", "amplitude_mm", "shift_mm", "cycles", "residual_mm"} <= swapped.keys()


def test_a_model_states_how_it_was_learned(learned):
    quality = learned.provenance.quality
    assert quality.amplitude_mm == pytest.approx(5.4, abs=0.5)
    assert 0.5 < quality.explained_share <= 1.0
    assert quality.shift_mm < 2.0
    assert learned.provenance.settings["min_cycles"] == 1.0
    assert learned.provenance.origin is None
    assert learned.surface_mm.shape[1] == 3


# -- a model of an earlier fraction -----------------------------------------------------------------------------------


def resumed(learned, *, limits=None, most=400, **surface):
    patient = Patient(match_limits=limits)
    patient.learner.models.resume(learned)
    patient.see_until(lambda: is_compared(patient), most=most, **surface)
    return patient


def is_compared(patient):
    """Whether the comparison has ended: with the model, or without."""
    return patient.learner.active is None or patient.learner.status.model_shortcoming is None


def test_a_stored_model_measures_at_once_but_arming_is_refused_until_it_was_compared(learned):
    patient = Patient()
    patient.learner.models.resume(learned)
    assert patient.see() is not None
    assert "compared" in patient.learner.status.model_shortcoming
    with pytest.raises(CommandRefusedError, match="compared"):
        patient.learner.retrain()
    patient.see_until(lambda: patient.learner.status.patient_match is not None)
    assert patient.learner.status.model_shortcoming is None
    assert patient.reported(LearningEventKind.COMPARED)[0].figures["is_accepted"]


def test_the_reference_of_another_fraction_is_not_taken_over_a_person_sets_it(learned):
    patient = resumed(learned)
    assert patient.see() is not None
    assert not patient.learner.status.has_reference
    assert patient.reported(LearningEventKind.ZERO_NEEDED)
    patient.learner.set_reference()
    assert not patient.learner.status.has_reference
    patient.see()
    assert patient.learner.status.has_reference


def test_a_retraining_before_the_reference_was_set_does_not_set_it(learned):
    patient = resumed(learned)
    retrain(patient)
    patient.see()
    assert not patient.learner.status.has_reference


@pytest.mark.parametrize("shift_mm", [(0.0, 0.0, 0.0), (6.0, -4.0, 0.0), (0.0, 0.0, 9.0)], ids=str)
def test_shift_is_reported_in_mm_and_small_ones_are_accepted(learned, shift_mm):
    patient = resumed(learned, limits=PatientMatchLimits(seconds=4.0), shift_mm=shift_mm)
    likeness = patient.learner.status.patient_match
    assert likeness.refusal is None
    expected = (shift_mm[0] * (850 + shift_mm[2]) / 850, shift_mm[1] * (850 + shift_mm[2]) / 850, shift_mm[2])
    assert np.abs(np.subtract(likeness.shift_mm, expected)).max() < 2.5
    assert likeness.shape_mm < 2.0
    assert likeness.residual_mm < 1.5


@pytest.mark.parametrize(
    ("surface", "field"),
    [
        ({"shift_mm": (40.0, 0.0, 0.0)}, "model.shift_mm"),
        ({"shape": np.linspace(-30.0, 30.0, BELLY.shape[1]) + 0.0 * BELLY}, "model.tilt_deg"),
        ({"shape": 8.0 * np.cos(np.linspace(0.0, 2.0 * np.pi, BELLY.shape[1])) + 0.0 * CHEST}, "model.shape_mm"),
    ],
    ids=["elsewhere", "turned", "another body"],
)
def test_a_patient_too_far_from_the_model_is_refused_by_figure_and_a_new_model_is_learned(learned, surface, field):
    patient = resumed(learned, **surface)
    assert patient.learner.status.patient_match.refusal.field == field
    assert patient.reported(LearningEventKind.REFUSED)[0].figures["field"] == field
    assert patient.learner.active is None
    assert patient.learner.models.is_gathering
    assert field in patient.learner.models.progress.note
    fresh = patient.learn(**surface)
    assert fresh is not learned
    assert patient.learner.status.model_shortcoming is None


def test_a_hand_in_view_during_the_comparison_costs_no_model(learned):
    """The comparison that it spoils is made once more."""
    patient = Patient()
    patient.learner.models.resume(learned)
    ripples = 12.0 * np.sin(np.linspace(0.0, 12.0 * np.pi, BELLY.shape[1])) + 0.0 * BELLY
    patient.see_until(lambda: patient.reported(LearningEventKind.COMPARED), shape=ripples)
    assert not patient.reported(LearningEventKind.COMPARED)[0].figures["is_accepted"]
    assert "compared" in patient.learner.status.model_shortcoming
    patient.see_until(lambda: is_compared(patient))
    assert patient.learner.active.model is learned
    assert patient.learner.status.patient_match.refusal is None
    assert [one.figures["is_accepted"] for one in patient.reported(LearningEventKind.COMPARED)] == [False, True]


def test_a_second_refusal_is_final(learned):
    patient = resumed(learned, shift_mm=(40.0, 0.0, 0.0))
    assert [one.figures["is_accepted"] for one in patient.reported(LearningEventKind.COMPARED)] == [False, False]
    assert patient.learner.active is None


def test_a_body_the_model_cannot_explain_is_refused(learned):
    ripples = 12.0 * np.sin(np.linspace(0.0, 12.0 * np.pi, BELLY.shape[1])) + 0.0 * BELLY
    limits = PatientMatchLimits(seconds=1.0, max_shape_mm=30.0)
    patient = resumed(learned, limits=limits, shape=ripples)
    assert patient.learner.status.patient_match.refusal.field in {"model.explained_share", "model.residual_mm"}


def test_a_model_of_another_calibration_is_refused_before_anything_happens(learned):
    patient = Patient(sha256="d" * 64)
    for command in (patient.learner.models.resume, patient.learner.activate):
        with pytest.raises(ModelMismatchError) as refusal:
            command(learned)
        assert refusal.value.field == "model.calibration_sha256"
        assert SHA256[:12] in refusal.value.value
    assert patient.learner.models.is_gathering


def test_a_model_that_does_not_say_where_its_patient_lay_is_not_begun_with(learned):
    with pytest.raises(ModelMismatchError, match="older version"):
        Patient().learner.models.resume(replace(learned, surface_mm=None))


def test_a_patient_who_is_not_seen_is_not_compared(learned):
    patient = Patient()
    patient.learner.models.resume(learned)
    for _ in range(200):
        patient.index += 200  # six seconds between two frames: never a look in one piece
        patient.see()
    assert patient.learner.status.patient_match is None
    assert "compared" in patient.learner.status.model_shortcoming


# -- rigid ----------------------------------------------------------------------------------------------------------


def test_a_rigid_motion_is_found_whatever_points_are_missing():
    random = np.random.default_rng(2)
    points = random.uniform((-150.0, -150.0, 700.0), (150.0, 150.0, 1000.0), (200, 3))
    angle = np.deg2rad(5.0)
    turn = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    center = points[50:].mean(axis=0)
    moved = (points - center) @ turn.T + center + (3.0, -2.0, 7.0)
    moved[:50] = np.nan
    fit = rigid_between(points, moved)
    assert np.allclose(fit.shift_mm, (3.0, -2.0, 7.0), atol=1e-9)
    assert fit.tilt_deg == pytest.approx(5.0)
    assert fit.shape_mm == pytest.approx(0.0, abs=1e-9)
    assert rigid_between(points[:40], moved[:40]) is None


def test_a_mirrored_surface_is_no_rotation():
    points = np.random.default_rng(3).uniform(-100.0, 100.0, (60, 3))
    assert rigid_between(points, points * (-1.0, 1.0, 1.0)).shape_mm > 10.0
