"""Holds from several threads while one thread permits without a pause."""

import threading

from engine.beam.line import BeamLine
from engine.core.clock import NS_PER_MS, Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease


def hold_in_the_rain(line: BeamLine, clock: Clock, *, threads: int) -> int:
    """Permit until each thread has held 300 times, and then for a fault; return the last sequence."""
    start = threading.Barrier(threads + 1)

    def hold() -> None:
        start.wait()
        for _ in range(300):
            line.hold(HoldReason.OUTSIDE_WINDOW)
        line.hold(HoldReason.WATCHDOG)

    holding = [threading.Thread(target=hold) for _ in range(threads)]
    for thread in holding:
        thread.start()
    start.wait()
    sequence = 0
    while any(thread.is_alive() for thread in holding) or sequence < 300:
        sequence += 1
        now_ns = clock.now_ns()
        try:
            line.permit(Lease(sequence=sequence, granted_ns=now_ns, expires_ns=now_ns + 80 * NS_PER_MS))
        except BeamLineError:
            continue
    for thread in holding:
        thread.join()
    return sequence
