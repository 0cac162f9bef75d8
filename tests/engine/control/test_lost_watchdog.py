"""A watchdog whose thread has died watches no one: the beam is not left to an engine that no one watches."""

from engine.core.commands import Acknowledge, Arm
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import LEARNED, armed_bench
from tests.support.control.loop_bench import after, good

ON = LEARNED + 6
"""The newest frame when six were good after the arming: the beam is on."""


def _on_until_it_dies(monkeypatch, more: list):
    """Six good frames with the beam on; then the watchdog's thread is no more."""
    bench = armed_bench([good] * 6)
    is_watching = [True]
    bench.source.script += [after(is_watching.clear), *more]
    monkeypatch.setattr(type(bench.watchdog), "is_watching", property(lambda _self: bool(is_watching)))
    return bench


def test_the_line_is_off_at_the_next_decision_and_stays_off(monkeypatch):
    bench = _on_until_it_dies(monkeypatch, [good] * 8)
    records = bench.run().records()
    assert records[ON].line_on
    later = {(record.gate_state, record.hold_reason, record.line_on) for record in records[ON + 1 :]}
    assert later == {(GateState.FAULT, HoldReason.WATCHDOG, False)}
    (reported,) = [change for change in bench.transitions() if change.reason is HoldReason.WATCHDOG]
    assert (reported.to_state, reported.detail) == (GateState.FAULT, "the watchdog's thread has died")


def test_who_acknowledges_is_refused_to_arm(monkeypatch):
    bench = _on_until_it_dies(monkeypatch, [good])
    orders = (Acknowledge(operator="bob"), Arm(operator="bob"))
    bench.source.script += [step for order in orders for step in (after(bench.ask(order)), *[good] * 8)]
    records = bench.run().records()
    assert not any(record.line_on for record in records[ON + 1 :])
    assert records[-1].gate_state is GateState.DISARMED
    refusal = bench.answers[-1].exception()
    assert isinstance(refusal, CommandRefusedError)
    assert "the watchdog does not run" in str(refusal)
