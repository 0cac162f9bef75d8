"""Do something to the camera while the beam is on, and see the beam off within a bound."""

import time

import pytest

MS = 1_000_000


def off_in_time(live, watchman, cause, bound_ms):
    """Once more where the beam was off too late by no more than the machine has stood still meanwhile; six times."""
    for _ in range(6):
        receipt, off_ns = see_off(live, cause)
        on_ms = (off_ns - receipt.raised_ns) / MS
        if on_ms <= bound_ms:
            return receipt
        time.sleep(0.05)  # what the watchman has seen takes a moment to be reported
        stood_ms = watchman.stalled_ms(receipt.raised_ns, off_ns)
        assert on_ms <= bound_ms + stood_ms, f"off {on_ms:.0f} ms after, {bound_ms:g} allowed, {stood_ms:.0f} stood"
        live.camera.undo()
    pytest.fail("the machine stands still again and again")


def see_off(live, cause):
    """Do it; returns the receipt, and when the receiver was off [ns]."""
    for _ in range(20):
        live.turn_on()
        time.sleep(0.1)
        before_ns = time.monotonic_ns()
        if not live.is_on:
            continue
        receipt = cause()
        live.until(lambda: not live.is_on, "an off")
        offs = live.offs(before_ns)
        if offs and offs[0] > receipt.raised_ns:  # else a busy machine had it off by itself: no result
            return receipt, offs[0]
        live.camera.undo()
    pytest.fail("the beam never stayed on until the fault")
