"""A beam line with the accelerator's beam-on signal as an input, compared with the permit by a thread of its own.

The comparison never permits anything, and waits for nothing: the signal is read by whoever exchanges with the wire.
"""

import contextlib
import threading

from engine.beam.beam_on import ABSENT_S, AFTER_PERMIT_MS, BeamOnComparison, BeamOnState, Permission, ReadBeamOn
from engine.beam.line import BeamLine, TroubleListener, ignore_trouble
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

COMPARE_NS = 10 * NS_PER_MS
REPORT_NS = NS_PER_S // 4
"""Period of the reports while the beam is on without a permit: an acknowledgement does not end them."""

CLOSE_S = 1.0


class ComparedBeamLine:
    """`BeamLine` around another one; a beam without a permit holds and latches it, and is reported as its fault.

    The permit is one attribute, the newest lease and the time of the first hold after it, so that a repeated hold does
    not start the beam's time anew.
    """

    def __init__(
        self,
        line: BeamLine,
        clock: Clock,
        read: ReadBeamOn,
        *,
        after_permit_ms: float = AFTER_PERMIT_MS,
        absent_s: float = ABSENT_S,
    ) -> None:
        self.on_trouble: TroubleListener = ignore_trouble
        self._line, self._clock, self._read = line, clock, read
        self._comparison = BeamOnComparison(after_permit_ms=after_permit_ms, absent_s=absent_s)
        self._permit: tuple[Lease, int, int | None] | None = None  # newest lease, permitted since, held at
        self._reported_ns: int | None = None
        self._is_over = threading.Event()
        self._forgets_absence = threading.Event()  # the comparison belongs to its own thread
        self._thread: threading.Thread | None = None
        line.on_trouble = self._forward_trouble

    @property
    def state(self) -> BeamOnState:
        """What the comparison knows."""
        return self._comparison.state

    def open(self) -> None:
        """Connect, and start to compare."""
        self._line.open()
        self._permit, self._reported_ns = None, None
        self._is_over = threading.Event()
        try:
            self._start_thread()
        except BaseException:
            self.close()
            raise

    def rearm(self) -> None:
        """Accept permits again; raise BeamLineError while the beam is on without one."""
        violation = self._comparison.violation
        if violation is not None:
            raise BeamLineError(violation)
        self._line.rearm()
        self._forgets_absence.set()

    def permit(self, lease: Lease) -> None:
        """Permit the beam until the lease ends."""
        self._line.permit(lease)
        since_ns = self._permission(lease.granted_ns).since_ns
        self._permit = (lease, lease.granted_ns if since_ns is None else since_ns, None)

    def hold(self, reason: HoldReason) -> None:
        """Withdraw the permit."""
        self._line.hold(reason)
        permit = self._permit
        if permit is not None and permit[2] is None:
            self._permit = (permit[0], permit[1], min(self._clock.now_ns(), permit[0].expires_ns))

    def is_on(self) -> bool:
        """Read back whether the line is on; raise BeamLineError where nothing compares any more."""
        thread = self._thread
        if thread is not None and not thread.is_alive():
            self.hold(HoldReason.BEAM_LINE_FAILED)
            msg = "the thread that compares the beam-on signal has died"
            raise BeamLineError(msg)
        return self._line.is_on()

    @property
    def is_settling(self) -> bool:
        """Whether the last command is not read back yet."""
        return self._line.is_settling

    def close(self) -> None:
        """Hold, stop comparing, and disconnect."""
        self.hold(HoldReason.ENGINE_STOPPED)
        self._is_over.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(CLOSE_S)
        self._line.close()

    def compare_once(self) -> None:
        """Compare the newest reading; hold, latch and report a beam without a permit, and again while it lasts."""
        if self._forgets_absence.is_set():
            self._forgets_absence.clear()
            self._comparison.forget_absence()
        is_on = self._read()
        now_ns = self._clock.now_ns()
        self._comparison.compare(self._permission(now_ns), is_on=is_on, now_ns=now_ns)
        violation = self._comparison.violation
        if violation is None:
            self._reported_ns = None
        elif self._reported_ns is None or now_ns - self._reported_ns >= REPORT_NS:
            self._reported_ns = now_ns
            self.hold(HoldReason.BEAM_WITHOUT_PERMIT)
            with contextlib.suppress(Exception):  # an error of the listener must not end the comparison
                self.on_trouble(HoldReason.BEAM_WITHOUT_PERMIT, violation)

    def _permission(self, now_ns: int) -> Permission:
        if self._permit is None:
            return Permission()
        lease, since_ns, held_ns = self._permit
        if held_ns is None and now_ns < lease.expires_ns:
            return Permission(since_ns=since_ns)
        return Permission(ended_ns=lease.expires_ns if held_ns is None else held_ns)

    def _forward_trouble(self, reason: HoldReason, detail: str) -> None:
        """Forward a fault of the line, which has held itself: the permit has ended."""
        self.hold(reason)
        self.on_trouble(reason, detail)

    def _start_thread(self) -> None:
        self._thread = threading.Thread(target=self._work, name="tidegate-beam-on", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._is_over.wait(COMPARE_NS / NS_PER_S):
            self.compare_once()
