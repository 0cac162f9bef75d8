"""When a patient is guided at all, what practice is, and rest after a breath hold."""

from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import HoldStage
from service.core.errors import BoundError, SessionStateError
from service.core.schemas.coaching import Coaching, PercentRange
from service.sessions.coaching.board import CoachingBoard
from tests.support.service.guided_patient import EXHALE, GuidedPatient

PRACTICE = Coaching(is_practice=True)
ANN = "A. Therapist"


@dataclass
class Log:
    """An audit that remembers."""

    events: list = field(default_factory=list)

    def write(self, event):
        self.events.append(event)

    @contextmanager
    def refusals(self, **_given):
        yield


@pytest.fixture
def patient() -> GuidedPatient:
    return GuidedPatient()


@pytest.fixture
def log() -> Log:
    return Log()


@pytest.fixture
def board(patient, log) -> CoachingBoard:
    return CoachingBoard(running=lambda _id: SimpleNamespace(engine=patient.running), log=log)


def word(board, live):
    found = board.guidance(live)
    return None if found is None else found.frame.instruction


def test_an_armed_patient_is_guided_and_a_disarmed_one_is_not(board, patient):
    assert word(board, patient.frame(5.0, HoldStage.AWAITED)) == "breathe_in"
    patient.disarm()
    assert board.guidance(patient.frame(5.0, HoldStage.AWAITED)) is None


def test_nothing_is_shown_without_a_session_a_reference_or_while_a_fault_is_latched(board, patient):
    assert board.guidance(None) is None
    assert board.guidance(patient.frame(5.0, status="ended")) is None
    patient.running.has_reference = False
    assert board.guidance(patient.frame(5.0)) is None
    patient.running.has_reference = True
    patient.disarm()
    patient.frame()
    board.set(patient.plan.session_id, PRACTICE, operator=ANN)
    patient.running.gate, patient.running.reason = GateState.FAULT, HoldReason.SOURCE_LOST
    assert board.guidance(patient.frame(5.0)) is None


def test_practice_guides_while_disarmed_and_states_it(board, patient):
    patient.disarm()
    board.set(patient.plan.session_id, PRACTICE, operator=ANN)
    found = board.guidance(patient.frame(5.0, HoldStage.AWAITED))
    assert (found.frame.instruction, found.settings.is_practice) == ("breathe_in", True)


def test_practice_is_refused_while_armed(board, patient, log):
    patient.frame()
    with pytest.raises(SessionStateError) as refused:
        board.set(patient.plan.session_id, PRACTICE, operator=ANN)
    assert (refused.value.field, refused.value.bound) == ("is_practice", "false while the gate is armed")
    assert log.events == []


def test_arming_ends_practice_for_good_though_no_screen_watched(board, patient):
    patient.disarm()
    board.set(patient.plan.session_id, PRACTICE, operator=ANN)
    board.end_practice(patient.plan.session_id)
    assert board.guidance(patient.frame(5.0)) is None
    assert not board.settings(patient.plan.session_id).is_practice


def test_an_armed_gate_ends_practice_anyone_who_armed_it(board, patient):
    patient.disarm()
    board.set(patient.plan.session_id, PRACTICE, operator=ANN)
    patient.arm()
    assert not board.guidance(patient.frame(5.0)).settings.is_practice
    patient.disarm()
    assert board.guidance(patient.frame(5.0)) is None


def test_the_next_session_begins_with_its_own_settings_and_the_same_language(board, patient):
    settings = Coaching(language="de", display="curve", band=PercentRange(lower_percent=145.0, upper_percent=175.0))
    patient.frame()
    board.set(patient.plan.session_id, settings, operator=ANN)
    assert board.guidance(patient.frame(5.0)).settings == settings
    next_patient = GuidedPatient(session_id="b" * 32)
    assert board.guidance(next_patient.frame(5.0)).settings == Coaching(language="de")


def test_settings_are_audited_with_what_was_before(board, patient, log):
    patient.frame()
    board.set(patient.plan.session_id, Coaching(sounds=True), operator=ANN)
    (event,) = log.events
    assert (event.actor, event.action, event.session_id) == (ANN, "coaching.set", patient.plan.session_id)
    assert (event.detail["before"]["sounds"], event.detail["after"]["sounds"]) == (False, True)


def test_a_band_outside_the_window_of_a_breath_hold_is_refused_with_the_bound(board, patient):
    patient.frame()
    bound = "inside the window of the breath hold: 140 to 180 %"
    for lower, upper in ((130.0, 170.0), (150.0, 190.0)):
        wanted = Coaching(band=PercentRange(lower_percent=lower, upper_percent=upper))
        with pytest.raises(BoundError) as refused:
            board.set(patient.plan.session_id, wanted, operator=ANN)
        assert (refused.value.field, refused.value.bound) == ("band", bound)


def test_a_band_around_an_amplitude_window_is_the_therapist_s_choice(log):
    patient = GuidedPatient(EXHALE)
    board = CoachingBoard(running=lambda _id: SimpleNamespace(engine=patient.running), log=log)
    patient.frame()
    wanted = Coaching(band=PercentRange(lower_percent=-10.0, upper_percent=110.0))
    assert board.set(patient.plan.session_id, wanted, operator=ANN) == wanted


@pytest.mark.parametrize("name", ["band", "scale"])
def test_per_cent_of_a_range_that_is_not_known_are_refused(board, patient, name):
    patient.running.learned_ranges = {}
    patient.frame()
    with pytest.raises(BoundError) as refused:
        board.set(
            patient.plan.session_id,
            Coaching(**{name: PercentRange(lower_percent=0.0, upper_percent=100.0)}),
            operator=ANN,
        )
    assert refused.value.field == name


def test_after_a_hold_the_patient_rests_before_the_next(board, patient):
    frames = [
        (5.0, HoldStage.AWAITED, 0.0, None),
        (16.0, HoldStage.SETTLING, 1.0, None),
        (16.0, HoldStage.HELD, 2.0, 2.0),
        (16.0, HoldStage.OVER, 22.0, 2.0),
        (6.0, HoldStage.AWAITED, 23.0, None),
        (6.0, HoldStage.AWAITED, 32.9, None),
        (6.0, HoldStage.AWAITED, 33.1, None),
    ]
    words = [word(board, patient.frame(mm, stage, at_s=at_s, held_since_s=held)) for mm, stage, at_s, held in frames]
    assert words == ["breathe_in", "hold", "hold", "breathe_out", "breathe_freely", "breathe_freely", "breathe_in"]


def test_a_hold_that_the_patient_ends_is_followed_by_a_rest_too(board, patient):
    word(board, patient.frame(16.0, HoldStage.HELD, at_s=2.0, held_since_s=2.0))
    assert word(board, patient.frame(6.0, HoldStage.AWAITED, at_s=5.0)) == "breathe_freely"


def test_a_lost_frame_in_a_hold_is_no_rest(board, patient):
    word(board, patient.frame(16.0, HoldStage.HELD, at_s=2.0, held_since_s=2.0))
    assert word(board, patient.frame(None, HoldStage.AWAITED, at_s=2.03, held_since_s=2.0)) == "none"
    assert word(board, patient.frame(16.0, HoldStage.SETTLING, at_s=2.07, held_since_s=2.0)) == "hold"


def test_a_level_that_is_only_passed_is_followed_by_no_rest(board, patient):
    word(board, patient.frame(16.0, HoldStage.SETTLING, at_s=2.0))
    assert word(board, patient.frame(6.0, HoldStage.AWAITED, at_s=3.0)) == "breathe_in"
