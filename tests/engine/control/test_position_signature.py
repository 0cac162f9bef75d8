"""A later fraction is armed only when a person has signed the position, and a signature ends when it may be untrue."""

from dataclasses import replace

import numpy as np
import pytest

from engine.control.fraction_checks import PositionSignature
from engine.control.session_state import SessionLimits
from engine.core.clock import NS_PER_S, ManualClock
from engine.core.commands import Arm, Disarm, HoldBeam, ReleaseBeam, SetReference, SignPosition
from engine.core.errors import CommandRefusedError, PositionUncheckedError
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.core.position_check import PositionCheck
from tests.support.control.loop_bench import Bench, RecordingPipeline, after, good
from tests.support.gating.streams import LIMITS, measured, unmeasured

WITHIN = PositionCheck(
    shift_mm=(0.5, -0.6, 0.7),
    turn_deg=(0.1, 0.2, -0.3),
    shift_uncertainty_mm=(0.5, 0.5, 0.1),
    turn_uncertainty_deg=(0.1, 0.2, 0.3),
    shape_mm=0.6,
)
BEYOND = replace(WITHIN, shift_mm=(0.5, 2.4, 0.7))
UNDETERMINED = replace(WITHIN, shift_uncertainty_mm=(0.5, 1.3, 0.1))
UNKNOWN = PositionCheck(unknown="it was measured with another calibration")
ARM = Arm(operator="ann")
SIGN = SignPosition(operator="ann", reference_number=1, may_exceed=True)
SURFACE_MM = np.stack(
    [
        *np.meshgrid(np.linspace(-90.0, 90.0, NODE_COLUMNS), np.linspace(-160.0, 160.0, NODE_ROWS)),
        np.full((NODE_ROWS, NODE_COLUMNS), 850.0),
    ],
    axis=-1,
).reshape(-1, 3)
REASON = {"reason": "longitudinal by the lasers"}


def asked(*commands, check=WITHIN, prepare=lambda _bench: None, frames=12):
    """Ask for commands one after the other; return the bench and the error of each answer."""
    bench = Bench([good] * 3, limits=LIMITS)
    bench.pipeline.is_position_required, bench.pipeline.position_check = True, check
    bench.pipeline.surface_mm = SURFACE_MM
    prepare(bench)
    for command in commands:
        act = bench.ask(command) if not callable(command) else (lambda act=command: act(bench))
        bench.source.script += [after(act), *[good] * frames]
    bench.run()
    return bench, [answer.exception(timeout=0) for answer in bench.answers]


def test_without_an_earlier_fraction_nothing_is_to_be_signed():
    bench, (armed, signed) = asked(
        ARM, SIGN, prepare=lambda bench: setattr(bench.pipeline, "is_position_required", False)
    )
    assert armed is None
    assert isinstance(signed, PositionUncheckedError)
    assert bench.records()[-1].line_on
    assert not bench.loop.status.view.position.is_required


def test_an_unsigned_position_is_not_armed():
    bench, (error,) = asked(ARM)
    assert isinstance(error, PositionUncheckedError)
    assert "signed" in str(error)
    assert not any(record.line_on for record in bench.records())


def test_a_signed_position_is_armed_and_the_view_names_who_signed():
    bench, errors = asked(SIGN, ARM)
    assert errors == [None, None]
    assert bench.records()[-1].line_on
    state = bench.loop.status.view.position
    assert (state.signature.operator, state.signature.reference_number, state.shortcomings) == ("ann", 1, ())


@pytest.mark.parametrize("check", [BEYOND, UNDETERMINED, UNKNOWN, None])
@pytest.mark.parametrize("who", [{}, {"may_exceed": True}, REASON, {"may_exceed": True, "reason": "  "}])
def test_beyond_the_tolerance_a_person_who_may_arm_gives_a_reason(check, who):
    command = SignPosition(operator="bob", reference_number=1, **who)
    bench, (signed, armed) = asked(command, ARM, check=check)
    assert isinstance(signed, PositionUncheckedError)
    assert ("has to give a reason" if who.get("may_exceed") else "only a person who may arm") in str(signed)
    assert isinstance(armed, PositionUncheckedError)
    assert bench.loop.status.view.position.signature is None


@pytest.mark.parametrize("check", [BEYOND, UNDETERMINED, UNKNOWN])
def test_with_a_reason_it_is_signed_and_armed(check):
    bench, errors = asked(replace(SIGN, **REASON), ARM, check=check)
    assert errors == [None, None]
    assert bench.loop.status.view.position.signature.reason == "longitudinal by the lasers"


def test_the_signature_of_another_reference_is_refused():
    for number in (0, 2):
        _, (signed, armed) = asked(replace(SIGN, reference_number=number), ARM)
        assert isinstance(signed, PositionUncheckedError)
        assert "look again" in str(signed)
        assert isinstance(armed, PositionUncheckedError)


def test_a_new_reference_needs_a_new_signature():
    new = SetReference(operator="bob")
    bench, errors = asked(SIGN, new, ARM, replace(SIGN, reference_number=2), ARM)
    assert [type(error) for error in errors] == [type(None)] * 2 + [PositionUncheckedError] + [type(None)] * 2
    assert bench.loop.status.view.position.signature.reference_number == 2


def test_without_a_reference_nothing_is_signed():
    def prepare(bench):
        bench.pipeline.has_reference = False

    _, (signed, armed) = asked(SIGN, ARM, prepare=prepare)
    assert isinstance(signed, PositionUncheckedError)
    assert isinstance(armed, CommandRefusedError)


def spoil_from_now(spoil, frames=3):
    """An act that spoils the next frames."""

    def act(bench):
        at = bench.source.frames
        for index in range(at, at + frames):
            bench.pipeline.spoil[index] = spoil

    return act


def away(frame):
    return replace(frame, motion=replace(frame.motion, surface_mm=frame.motion.surface_mm + np.array([40.0, 0.0, 0.0])))


def pushed(frame):
    return unmeasured(frame, MeasurementState.LOST, LostReason.CAMERA_MOVED)


@pytest.mark.parametrize("moved", [away, pushed])
def test_a_move_ends_the_signature_even_if_the_patient_comes_back(moved):
    bench, errors = asked(SIGN, ARM, spoil_from_now(moved), SIGN, frames=20)
    assert errors[:2] == [None, None]
    assert isinstance(errors[2], PositionUncheckedError)
    assert "set the reference again" in str(errors[2])
    last = bench.records()[-1]
    assert (last.gate_state, last.hold_reason) == (GateState.HOLD, HoldReason.POSITION_UNCHECKED)
    state = bench.loop.status.view.position
    assert state.signature is None
    assert state.lapse


def test_a_move_between_signature_and_arming_refuses_the_arming():
    bench, errors = asked(SIGN, spoil_from_now(away), ARM, frames=20)
    assert errors[0] is None
    assert isinstance(errors[1], PositionUncheckedError)
    assert not any(record.line_on for record in bench.records())


def test_after_a_move_a_new_reference_can_be_signed():
    again = (SetReference(operator="bob"), replace(SIGN, reference_number=2), ARM)
    bench, errors = asked(SIGN, ARM, spoil_from_now(away), *again, frames=20)
    assert errors == [None] * 5
    assert bench.records()[-1].line_on


def test_a_lost_marker_for_a_moment_ends_nothing():
    def hidden(frame):
        return unmeasured(frame, MeasurementState.LOST, LostReason.MARKER_LOST)

    bench, errors = asked(SIGN, ARM, spoil_from_now(hidden), frames=20)
    assert errors == [None, None]
    assert bench.records()[-1].line_on


def test_a_patient_who_was_not_measured_for_a_minute_is_compared_again():
    def hidden(frame):
        return unmeasured(frame, MeasurementState.LOST, LostReason.MARKER_LOST)

    def minute(bench):
        bench.clock.advance_ns(61_000_000_000)

    bench, errors = asked(SIGN, spoil_from_now(hidden, frames=30), minute, ARM, SIGN, frames=10)
    assert errors[0] is None
    assert all(isinstance(error, CommandRefusedError) for error in errors[1:])
    assert "60 s" in bench.loop.status.view.position.lapse


def test_disarming_keeps_the_signature_of_a_patient_who_lies_still():
    bench, errors = asked(SIGN, ARM, Disarm(operator="ann"), ARM, HoldBeam(operator="ann"), ReleaseBeam(operator="ann"))
    assert errors == [None] * 6
    assert bench.records()[-1].line_on


def test_a_refusal_names_the_tolerance_and_every_shortcoming():
    unsigned = SignPosition(operator="bob", reference_number=1)
    tolerance = f"{LIMITS.max_position_shift_mm:g} mm and {LIMITS.max_position_turn_deg:g} deg"
    bench, (error,) = asked(unsigned, check=replace(BEYOND, shape_mm=9.0))
    found = bench.loop.status.view.position.shortcomings
    assert len(found) == 2
    assert f"the position is not within {tolerance} of the plan's ({found[0]}, {found[1]}): " in str(error)
    _, (error,) = asked(unsigned, check=None)
    assert f"the position is not within {tolerance} of the plan's (it was not compared): " in str(error)


def test_the_first_of_several_moves_is_named_as_what_ended_the_signature():
    bench, _ = asked(SIGN, spoil_from_now(pushed), spoil_from_now(away), frames=20)
    assert bench.loop.status.view.position.lapse == "the camera moved"


def test_where_nothing_is_to_be_signed_no_move_ends_anything():
    bench, _ = asked(
        spoil_from_now(pushed), prepare=lambda bench: setattr(bench.pipeline, "is_position_required", False)
    )
    assert bench.loop.status.view.position.lapse == ""


def test_the_state_shows_the_reference_in_use_with_its_comparison():
    state = asked()[0].loop.status.view.position
    assert (state.is_required, state.reference_number, state.check) == (True, 1, WITHIN)
    assert (state.signature, state.lapse) == (None, "")

    def prepare(bench):
        bench.pipeline.has_reference = False

    assert asked(prepare=prepare)[0].loop.status.view.position.reference_number is None


def test_the_lapse_of_an_earlier_reference_is_not_that_of_the_one_in_use():
    bench, _ = asked(SIGN, spoil_from_now(pushed), SetReference(operator="bob"), frames=20)
    state = bench.loop.status.view.position
    assert (state.reference_number, state.lapse) == (2, "")


@pytest.mark.parametrize(("beyond_ns", "lapse"), [(0, ""), (1, "the patient was not measured for more than 60 s")])
def test_a_patient_may_be_unmeasured_for_a_minute_itself(beyond_ns, lapse):
    pipeline = RecordingPipeline(ManualClock(0))
    pipeline.is_position_required, pipeline.position_check = True, WITHIN
    sign_off = PositionSignature(pipeline, SessionLimits(LIMITS))
    first = measured(10**6)
    sign_off.follow(first, ())
    hidden = unmeasured(first, MeasurementState.LOST, LostReason.MARKER_LOST)
    sign_off.follow(replace(hidden, received_ns=first.received_ns + 60 * NS_PER_S + beyond_ns), ())
    assert sign_off.present().lapse == lapse


def test_a_fault_found_while_a_signature_is_carried_out_is_recorded_with_who_signed():
    def fault_and_sign(bench):
        def act(_lease):
            bench.beam.before_permit = lambda _lease: None
            bench.loop.report_fault(HoldReason.DISK_LOW, "10 MB left")
            bench.ask(replace(SIGN, operator="cid"))()

        bench.beam.before_permit = act

    bench, _ = asked(SIGN, ARM, fault_and_sign)
    fault = next(one for one in bench.transitions() if one.to_state is GateState.FAULT)
    assert (fault.reason, fault.operator) == (HoldReason.DISK_LOW, "cid")
