"""Every interlock, tripped once in an engine that runs, with the line in a process of its own: what the line saw."""

from collections.abc import Mapping

import pytest

from engine.core.gate_state import INTERLOCKS, HoldReason
from tests.support.beam.datagram_receiver import MAX_TRANSIT_NS
from tests.support.gating.streams import MS
from verification.interlocks.live_run import NEVER_ON, Outcome, is_ever_on, run_all
from verification.interlocks.trips import TRIPS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240), pytest.mark.alone]

BY_ITSELF, BY_A_PERSON, NEVER = "by itself, after the dwell", "acknowledged and armed", "in a new session"
CANNOT_BE_TRIPPED = {HoldReason.UNKNOWN, *NEVER_ON, HoldReason.HEAD_DIRECTION_MISSING}
"""What has no cause that is known, and what is so from the first frame on: the latter have tests of their own, here and
in tests/engine/control/test_head_direction.py."""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> Mapping[HoldReason, Outcome]:
    """Trip everything once."""
    return {one.trip.code: one for one in run_all(tmp_path_factory.mktemp("lines"), TRIPS)}


def test_every_interlock_there_is_was_tripped_with_the_beam_on_and_took_it_off(outcomes):
    assert set(outcomes) == set(INTERLOCKS) - CANNOT_BE_TRIPPED
    assert {one.off.kind for one in outcomes.values()} <= {"held", "lapsed"}


def test_the_line_was_off_before_the_last_permit_s_lease_had_ended_whatever_happened(outcomes):
    late = {
        code: (one.off.at_ns - one.lease_end_ns) / MS
        for code, one in outcomes.items()
        if one.off.at_ns > one.lease_end_ns + MAX_TRANSIT_NS + 5 * MS
    }
    assert not late


def test_faults_stayed_off_until_somebody_acknowledged_and_armed_and_holds_came_back_by_themselves(outcomes):
    """That the beam stayed off meanwhile, and that the dwell was full, is asserted where it is seen."""
    for code, one in outcomes.items():
        back = BY_A_PERSON if code.is_fault else BY_ITSELF
        assert one.back == (NEVER if one.trip.ends_session else back), code


def test_an_engine_that_hangs_is_taken_off_by_the_line_itself(outcomes):
    """No one held it: the lease lapsed where it is kept."""
    assert outcomes[HoldReason.WATCHDOG].off.kind == "lapsed"
    assert outcomes[HoldReason.FRAME_STALE].off.kind == "lapsed"


@pytest.mark.parametrize("reason", NEVER_ON)
def test_a_camera_that_was_never_calibrated_or_is_cold_never_has_a_beam(tmp_path, reason):
    assert not is_ever_on(tmp_path, reason)
