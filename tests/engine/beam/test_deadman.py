"""The rule of every line: on is a function of the lease, the newest hold and the clock; a hold wins every race."""

import pytest
from hypothesis import given, strategies as st

from engine.beam.deadman import MAX_LEASE_NS, DeadMan, Grant
from engine.beam.simulated import BeamEdge, SimulatedBeamLine
from engine.core.clock import ManualClock, MonotonicClock
from engine.core.errors import BeamLineError, LeaseLapsedError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam.permit_rain import hold_in_the_rain

MS = 1_000_000


def _lease(sequence: int, granted_ms: int, expires_ms: int) -> Lease:
    return Lease(sequence=sequence, granted_ns=granted_ms * MS, expires_ns=expires_ms * MS)


def _open_line(at_ms: int = 0) -> tuple[SimulatedBeamLine, ManualClock]:
    clock = ManualClock(at_ms * MS)
    line = SimulatedBeamLine(clock)
    line.open()
    line.rearm()
    return line, clock


def _lit_line() -> tuple[SimulatedBeamLine, ManualClock]:
    line, clock = _open_line(100)
    line.permit(_lease(1, 100, 180))
    assert line.is_on()
    return line, clock


def test_a_line_is_off_until_it_was_opened_armed_and_permitted():
    line = SimulatedBeamLine(ManualClock(100 * MS))
    for prepare in (lambda: None, line.open):
        prepare()
        with pytest.raises(BeamLineError):
            line.permit(_lease(1, 100, 180))
        assert not line.is_on()
    line.rearm()
    assert not line.is_on()
    line.permit(_lease(1, 100, 180))
    assert line.is_on()


def test_a_lease_lapses_by_itself_at_its_end_and_stays_lapsed():
    line, clock = _lit_line()
    clock.advance_ns(80 * MS - 1)
    assert line.is_on()
    clock.advance_ns(1)
    assert not line.is_on()
    with pytest.raises(BeamLineError):
        line.permit(_lease(1, 100, 180))
    with pytest.raises(BeamLineError, match="lapsed"):
        line.permit(_lease(2, 150, 180))
    with pytest.raises(LeaseLapsedError):
        line.permit(_lease(3, 180, 260))
    assert not line.is_on()
    line.hold(HoldReason.FRAME_LATE)
    clock.advance_ns(MS)
    line.permit(_lease(4, 181, 261))
    assert line.is_on()


@pytest.mark.parametrize("reason", list(HoldReason), ids=str)
def test_any_hold_is_off_at_once(reason):
    line, _ = _lit_line()
    line.hold(reason)
    assert not line.is_on()


@pytest.mark.parametrize("reason", list(HoldReason), ids=str)
def test_only_a_fault_latches_until_rearmed(reason):
    line, clock = _lit_line()
    line.hold(reason)
    clock.advance_ns(10 * MS)
    if reason.is_fault:
        with pytest.raises(BeamLineError, match="latched"):
            line.permit(_lease(2, 110, 190))
        assert not line.is_on()
        line.rearm()
        assert not line.is_on()
    line.permit(_lease(2, 110, 190))
    assert line.is_on()


def test_a_later_harmless_hold_does_not_undo_a_latch():
    line, clock = _lit_line()
    line.hold(HoldReason.WATCHDOG)
    line.hold(HoldReason.OUTSIDE_WINDOW)
    clock.advance_ns(10 * MS)
    with pytest.raises(BeamLineError, match="latched"):
        line.permit(_lease(2, 110, 190))


@pytest.mark.parametrize("granted_ms", [90, 100])
def test_a_permit_decided_before_or_with_the_newest_hold_is_refused(granted_ms):
    line, clock = _open_line(100)
    line.hold(HoldReason.OUTSIDE_WINDOW)
    clock.advance_ns(5 * MS)
    with pytest.raises(BeamLineError, match="before the newest hold"):
        line.permit(_lease(1, granted_ms, 180))
    assert not line.is_on()


@pytest.mark.parametrize("sequence", [0, 1])
def test_a_permit_out_of_order_or_stated_twice_is_refused(sequence):
    line, _ = _lit_line()
    with pytest.raises(BeamLineError, match="after permit 1"):
        line.permit(_lease(sequence, 100, 190))


def test_a_lease_longer_than_any_lease_may_be_is_refused():
    line, _ = _open_line(100)
    with pytest.raises(BeamLineError, match="more than"):
        line.permit(Lease(sequence=1, granted_ns=100 * MS, expires_ns=100 * MS + MAX_LEASE_NS + 1))
    line.permit(Lease(sequence=2, granted_ns=100 * MS, expires_ns=100 * MS + MAX_LEASE_NS))
    assert line.is_on()


def test_closing_holds_and_a_closed_line_takes_nothing():
    line, clock = _lit_line()
    line.close()
    assert not line.is_on()
    line.hold(HoldReason.DISARMED)
    line.close()
    clock.advance_ns(MS)
    with pytest.raises(BeamLineError):
        line.permit(_lease(2, 101, 190))


def test_a_line_used_again_starts_off_and_needs_arming():
    line, clock = _lit_line()
    line.close()
    clock.advance_ns(MS)
    line.open()
    with pytest.raises(BeamLineError, match="latched"):
        line.permit(_lease(1, 101, 150))
    line.rearm()
    line.permit(_lease(1, 101, 150))  # a new engine counts from one again
    assert line.is_on()


def test_the_log_shows_every_edge_with_its_time_and_lapses_without_a_reason():
    line, clock = _lit_line()
    clock.advance_ns(33 * MS)
    line.permit(_lease(2, 133, 213))
    clock.advance_ns(20 * MS)
    line.hold(HoldReason.OUTSIDE_WINDOW)
    line.hold(HoldReason.OUTSIDE_WINDOW)
    clock.advance_ns(10 * MS)
    line.permit(_lease(3, 163, 243))
    clock.advance_ns(500 * MS)
    expected = [
        BeamEdge(at_ns=100 * MS, is_on=True),
        BeamEdge(at_ns=153 * MS, is_on=False, reason=HoldReason.OUTSIDE_WINDOW),
        BeamEdge(at_ns=163 * MS, is_on=True),
        BeamEdge(at_ns=243 * MS, is_on=False),
    ]
    assert list(line.edges) == expected
    line.hold(HoldReason.FRAME_LATE)
    clock.advance_ns(MS)
    line.permit(_lease(4, 664, 700))
    assert list(line.edges) == [*expected, BeamEdge(at_ns=664 * MS, is_on=True)]


class _InterruptedDeadMan(DeadMan):
    """Lets another thread's hold in at the worst moment: after a permit was found good, before it is taken."""

    def __init__(self, *, is_latching: bool, at_ns: int) -> None:
        super().__init__()
        self._is_latching, self._at_ns = is_latching, at_ns

    def _refusal(self, grant: Grant, now_ns: int) -> str | None:
        refusal = super()._refusal(grant, now_ns)
        self.hold(at_ns=self._at_ns, is_latching=self._is_latching)
        return refusal


@pytest.mark.parametrize(
    ("is_latching", "at_ns"),
    [(True, 110), (False, 110), (True, 90)],
    ids=["latching", "harmless", "latching, by a thread that was stopped after it had read its clock"],
)
def test_a_hold_that_comes_while_a_permit_is_taken_wins(is_latching, at_ns):
    deadman = _InterruptedDeadMan(is_latching=is_latching, at_ns=at_ns)
    deadman.rearm()
    deadman.grant(Grant(decided_ns=100, expires_ns=200, sequence=1), now_ns=110)
    assert not deadman.is_on(120)


def test_a_permit_asked_for_before_the_lapse_and_taken_after_it_changes_nothing():
    """Its thread was stopped after it had read its clock, and the line has gone off meanwhile."""
    deadman = DeadMan()
    deadman.rearm()
    deadman.grant(Grant(decided_ns=100, expires_ns=200, sequence=1), now_ns=110)
    assert not deadman.is_on(200)
    with pytest.raises(LeaseLapsedError):
        deadman.grant(Grant(decided_ns=190, expires_ns=290, sequence=2), now_ns=199)
    assert not deadman.is_on(203)
    deadman.hold(at_ns=300, is_latching=False)
    deadman.grant(Grant(decided_ns=301, expires_ns=400, sequence=3), now_ns=310)
    with pytest.raises(LeaseLapsedError):  # nobody has read the line since it lapsed
        deadman.grant(Grant(decided_ns=390, expires_ns=490, sequence=4), now_ns=400)
    assert not deadman.is_on(401)


acts = st.one_of(
    st.tuples(st.just("permit"), st.integers(0, 40), st.integers(1, 120)),
    st.tuples(st.just("hold"), st.sampled_from(list(HoldReason)), st.just(0)),
    st.tuples(st.just("rearm"), st.just(0), st.just(0)),
)


@given(st.lists(st.tuples(acts, st.integers(0, 60)), max_size=40))
def test_the_line_is_only_ever_on_within_a_lease_newer_than_every_hold(story):
    line, clock = _open_line(1_000)
    held_ns, is_latched, lease = -1, False, None
    for sequence, ((act, what, length_ms), wait_ms) in enumerate(story):
        now_ns = clock.now_ns()
        if act == "permit":
            asked = Lease(sequence=sequence, granted_ns=now_ns - what * MS, expires_ns=now_ns + length_ms * MS)
            is_good = not is_latched and asked.granted_ns > held_ns and (lease is None or lease.is_live(now_ns))
            try:
                line.permit(asked)
                assert is_good
                lease = asked
            except BeamLineError:
                assert not is_good
        elif act == "hold":
            line.hold(what)
            held_ns, lease = now_ns, None
            is_latched |= what.is_fault
        else:
            line.rearm()
            is_latched, lease = False, None
        assert line.is_on() is (lease is not None and lease.is_live(now_ns))
        clock.advance_ns(wait_ms * MS)
        assert line.is_on() is (lease is not None and lease.is_live(clock.now_ns()))


def test_holding_from_many_threads_while_permits_rain_ends_off():
    clock = MonotonicClock()
    line = SimulatedBeamLine(clock)
    line.open()
    line.rearm()
    sequence = hold_in_the_rain(line, clock, threads=4)
    assert not line.is_on()
    now_ns = clock.now_ns()
    late = Lease(sequence=sequence + 1, granted_ns=now_ns, expires_ns=now_ns + 80 * MS)
    with pytest.raises(BeamLineError, match="latched"):
        line.permit(late)


def test_permits_are_numbered_from_0_on_and_anew_after_each_arming():
    deadman = DeadMan()
    for _ in range(2):
        deadman.rearm()
        with pytest.raises(BeamLineError, match=r"^permit -1 came after permit -1$"):
            deadman.grant(Grant(decided_ns=0, expires_ns=80 * MS, sequence=-1), now_ns=0)
        deadman.grant(Grant(decided_ns=0, expires_ns=80 * MS, sequence=0), now_ns=0)
        with pytest.raises(BeamLineError, match=r"^permit 0 came after permit 0$"):
            deadman.grant(Grant(decided_ns=0, expires_ns=80 * MS, sequence=0), now_ns=0)


def test_a_refusal_states_why_in_these_words():
    deadman = DeadMan()
    grant = Grant(decided_ns=10, expires_ns=10 + MAX_LEASE_NS + 1, sequence=7)
    said = []
    for prepare in (lambda: None, deadman.rearm, lambda: deadman.hold(at_ns=10, is_latching=False)):
        prepare()
        with pytest.raises(BeamLineError) as refused:
            deadman.grant(grant, now_ns=10)
        said.append(str(refused.value))
    deadman.rearm()
    deadman.hold(at_ns=9, is_latching=False)
    with pytest.raises(BeamLineError) as refused:
        deadman.grant(grant, now_ns=grant.expires_ns)
    assert [*said, str(refused.value)] == [
        "the line is latched off until it is armed again",
        "permit 7 is for more than 250 ms",
        "permit 7 was decided before the newest hold",
        "permit 7 has lapsed already",
    ]
