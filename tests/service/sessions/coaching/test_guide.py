"""What a patient screen shows of a frame: places on a scale, and a word that follows the gate's own stage."""

import math
from dataclasses import replace

import pytest

from engine.core.commands import Arm
from engine.core.frames import Lost, LostReason
from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, HoldStage, JoinedWindow, PhaseWindow
from service.core.schemas.coaching import LONGEST_COUNTDOWN_S, Coaching, PercentRange
from service.sessions.coaching.guide import FOLLOWED, FREE, NOT_MEASURED, guide_frame
from tests.support.gating.streams import LIMITS, Stream
from tests.support.service.guided_patient import EXHALE, HOLD, LEARNED, LEVEL, GuidedPatient

BAND = Coaching(band=PercentRange(lower_percent=150.0, upper_percent=170.0))
EXPIRATION = replace(HOLD, kind="expiration", level=AmplitudeWindow(lower=-2.0, upper=1.0, hysteresis=0.2))


def seen(window, level_mm, stage=None, *, settings=None, learned=LEARNED, is_resting=False, **changes):
    view = GuidedPatient(window).frame(level_mm, stage, **changes).status.view
    return guide_frame(view, learned, settings or Coaching(), is_resting=is_resting)


@pytest.mark.parametrize(
    ("level_mm", "stage", "word"),
    [
        (5.0, HoldStage.AWAITED, "breathe_in"),
        (14.3, HoldStage.AWAITED, "breathe_in"),
        (16.0, HoldStage.SETTLING, "hold"),
        (16.0, HoldStage.HELD, "hold"),
        (16.0, HoldStage.DRIFTED, "breathe_out"),
        (16.0, HoldStage.OVER, "breathe_out"),
        (20.0, HoldStage.AWAITED, "breathe_out"),
        (16.0, HoldStage.AWAITED, "breathe_freely"),
    ],
)
def test_a_held_inspiration_is_in_then_hold_then_out(level_mm, stage, word):
    assert seen(HOLD, level_mm, stage).instruction == word


@pytest.mark.parametrize(
    ("level_mm", "stage", "word"),
    [
        (5.0, HoldStage.AWAITED, "breathe_out"),
        (0.0, HoldStage.HELD, "hold"),
        (0.0, HoldStage.OVER, "breathe_in"),
        (-4.0, HoldStage.AWAITED, "breathe_in"),
    ],
)
def test_a_held_expiration_is_out_then_hold_then_in(level_mm, stage, word):
    assert seen(EXPIRATION, level_mm, stage).instruction == word


def test_the_patient_is_led_into_the_therapist_s_band_before_the_word_is_hold():
    assert seen(HOLD, 14.5, HoldStage.SETTLING, settings=BAND).instruction == "breathe_in"
    assert seen(HOLD, 16.0, HoldStage.SETTLING, settings=BAND).instruction == "hold"
    assert seen(HOLD, 14.5, HoldStage.HELD, settings=BAND).instruction == "hold"


def test_the_edges_of_an_amplitude_window_command_nothing_and_a_band_of_a_person_does():
    band = Coaching(band=PercentRange(lower_percent=-10.0, upper_percent=110.0))
    for level_mm in (-3.0, 5.0, 14.0):
        assert seen(EXHALE, level_mm).instruction == "breathe_freely"
    words = [seen(EXHALE, level_mm, settings=band).instruction for level_mm in (-3.0, 5.0, 14.0)]
    assert words == ["breathe_in", "breathe_freely", "breathe_out"]


def test_rest_and_an_operator_s_hold_let_the_patient_breathe():
    assert seen(HOLD, 5.0, HoldStage.AWAITED, is_resting=True).instruction == "breathe_freely"
    assert seen(HOLD, 16.0, HoldStage.HELD, operator_holds=("C. Nurse",)).instruction == "breathe_freely"


@pytest.mark.parametrize("reason", [*HoldReason, None])
def test_only_a_frame_that_the_gate_trusts_is_shown(reason):
    patient = GuidedPatient(HOLD)
    view = patient.frame(16.0, HoldStage.HELD).status.view
    view = replace(view, record=replace(view.record, hold_reason=reason))
    found = guide_frame(view, LEARNED, Coaching(), is_resting=False)
    if reason in FOLLOWED:
        assert found.instruction == "hold"
    elif reason in FREE:
        assert (found.instruction, found.level is not None) == ("breathe_freely", True)
    else:
        assert found == NOT_MEASURED


def test_no_reason_that_doubts_the_frame_is_followed():
    doubts = {
        HoldReason.MARKER_LOST,
        HoldReason.LAYOUT_CHANGED,
        HoldReason.SURFACE_CHANGED,
        HoldReason.CAMERA_MOVED,
        HoldReason.PATIENT_SHIFTED,
        HoldReason.POSITION_UNCHECKED,
        HoldReason.FRAME_FROZEN,
        HoldReason.RESIDUAL_HIGH,
        HoldReason.COVERAGE_LOW,
        HoldReason.JUMP,
    }
    assert not doubts & (FOLLOWED | FREE)
    assert not [one for one in (FOLLOWED | FREE) - {None} if one.is_fault]


def test_a_frame_without_a_measurement_has_no_level_and_no_word():
    assert seen(HOLD, None, HoldStage.AWAITED) == NOT_MEASURED


def test_a_doubted_frame_is_not_shown_either_while_the_gate_is_disarmed():
    view = GuidedPatient(HOLD).frame(16.0, HoldStage.HELD).status.view
    doubted = replace(view.record.measurement, doubt=Lost(reason=LostReason.CAMERA_MOVED, detail="the couch has moved"))
    record = replace(view.record, hold_reason=HoldReason.DISARMED, measurement=doubted)
    assert guide_frame(replace(view, record=record), LEARNED, Coaching(), is_resting=False) == NOT_MEASURED


def test_the_scale_shows_breath_and_band_with_room_beyond():
    low, high, band = (seen(HOLD, level_mm, HoldStage.AWAITED) for level_mm in (0.0, 10.0, 16.0))
    assert 0.05 < low.level < high.level < band.level < 0.95
    assert band.band.lower < band.level < band.band.upper


def test_beyond_the_scale_the_level_stays_at_its_end():
    assert seen(HOLD, -60.0, HoldStage.AWAITED).level == 0.0
    assert seen(HOLD, 90.0, HoldStage.AWAITED).level == 1.0


def test_a_scale_and_a_band_of_the_therapist_are_in_per_cent_of_the_learned_range():
    settings = Coaching(
        band=PercentRange(lower_percent=50.0, upper_percent=75.0),
        scale=PercentRange(lower_percent=0.0, upper_percent=100.0),
    )
    found = seen(EXHALE, 2.5, settings=settings)
    assert (found.level, *found.band) == (0.25, 0.5, 0.75)


def test_a_band_beyond_the_window_of_a_breath_hold_is_cut_to_it():
    """The window may have moved since it was checked: a correction of the baseline."""
    wide = Coaching(
        band=PercentRange(lower_percent=100.0, upper_percent=200.0),
        scale=PercentRange(lower_percent=0.0, upper_percent=200.0),
    )
    assert seen(HOLD, 5.0, HoldStage.AWAITED, settings=wide).band == (0.7, 0.9)
    elsewhere = wide.model_copy(update={"band": PercentRange(lower_percent=0.0, upper_percent=50.0)})
    assert seen(HOLD, 5.0, HoldStage.AWAITED, settings=elsewhere).band == (0.7, 0.9)


def test_without_a_learned_range_the_window_alone_gives_the_scale():
    found = seen(HOLD, 16.0, HoldStage.HELD, learned=None)
    assert (found.level, *found.band) == (0.5, pytest.approx(1 / 3, abs=1e-3), pytest.approx(2 / 3, abs=1e-3))


def test_a_window_in_per_cent_of_an_unknown_range_commands_nothing():
    percent = replace(HOLD, level=AmplitudeWindow(lower=100.0, upper=150.0, unit="percent"))
    assert seen(percent, 5.0, HoldStage.AWAITED).instruction == "breathe_freely"
    assert seen(percent, 5.0, HoldStage.AWAITED, learned=None) == NOT_MEASURED


def test_a_phase_window_shows_the_breath_without_a_band():
    found = seen(PhaseWindow(from_percent=30.0, to_percent=70.0), 5.0)
    assert (found.band, found.instruction) == (None, "breathe_freely")


def test_of_joined_conditions_the_breath_hold_on_the_first_signal_guides():
    assert seen(JoinedWindow(conditions=(LEVEL, HOLD)), 5.0).instruction == "breathe_in"
    assert seen(JoinedWindow(conditions=(LEVEL, EXHALE)), 5.0).instruction == "breathe_freely"
    other = JoinedWindow(conditions=(PhaseWindow(from_percent=30.0, to_percent=70.0), EXHALE))
    assert guide_frame(GuidedPatient(other).frame(2.0).status.view, LEARNED, Coaching(), is_resting=False).band


def test_the_countdown_is_the_rest_of_the_gate_s_own_time_limit():
    found = seen(HOLD, 16.0, HoldStage.HELD, at_s=12.5, held_since_s=5.0)
    assert found.countdown_s == 12.5
    assert seen(HOLD, 16.0, HoldStage.SETTLING, at_s=12.5).countdown_s is None, "it has not settled yet"
    again = seen(HOLD, 16.0, HoldStage.SETTLING, at_s=12.5, held_since_s=5.0)
    assert again.countdown_s == 12.5, "a lost frame does not lengthen a hold"
    assert seen(HOLD, 16.0, HoldStage.OVER, at_s=26.0, held_since_s=5.0).countdown_s is None
    assert seen(HOLD, 16.0, HoldStage.HELD, at_s=26.0, held_since_s=5.0).countdown_s == 0.0


def test_the_longest_breath_hold_fits_the_message():
    longest = replace(HOLD, timeout_s=LONGEST_COUNTDOWN_S)
    assert seen(longest, 16.0, HoldStage.HELD, at_s=0.0, held_since_s=0.0).countdown_s == LONGEST_COUNTDOWN_S


def test_every_level_is_a_place_on_the_scale():
    for level_mm in (-1e6, -0.1, 0.0, 3.3, 1e6):
        found = seen(HOLD, level_mm, HoldStage.AWAITED)
        assert 0.0 <= found.level <= 1.0
        assert math.isfinite(found.level)


def test_the_gate_follows_a_breath_hold_while_it_is_disarmed_so_that_practice_is_like_the_treatment():
    window = BreathHoldWindow(level=AmplitudeWindow(lower=18.0, upper=24.0), settle_ms=500.0, still=0.6, timeout_s=3.0)
    words = {}
    for is_armed in (False, True):
        stream = Stream(replace(LIMITS, window=window, max_jump_mm=20.0), 6.0)
        stream.good(2)
        if is_armed:
            stream.step(Arm(operator="ann"))
        words[is_armed] = [_word(stream, level_mm) for level_mm in [6.0] * 5 + [21.0] * 110 + [6.0] * 5]
        assert (stream.gate.state is GateState.DISARMED) == (not is_armed)
    assert words[False] == words[True]
    assert list(dict.fromkeys(words[False])) == [HoldStage.AWAITED, HoldStage.SETTLING, HoldStage.HELD, HoldStage.OVER]


def _word(stream, level_mm):
    stream.level_mm = level_mm
    return stream.feed().conditions[0].stage
