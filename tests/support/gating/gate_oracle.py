"""The gate's rules as a plain reading of docs/2-clinical/safety.md, without states, tables or code of the engine.

Facts go in: what a frame showed and when, who asked for what. What comes out is where the gate must be. It keeps the
run of good frames since anything else happened, and when the beam went on and off; all else follows from those.
"""

from dataclasses import dataclass, field

MS = 1_000_000
MINUTE_NS = 60_000 * MS


LATCHING = frozenset(
    {
        *("frame_stale", "frame_timeout", "clock_backwards", "clock_jumped", "latency_high"),
        *("value_invalid", "source_lost", "beam_line_failed", "beam_line_mismatch", "beam_without_permit"),
        *("audit_behind", "recorder_behind", "disk_low", "service_silent", "watchdog"),
        *("engine_failed", "source_ended", "engine_stopped", "unknown"),
    }
)
"""What latches until a person acknowledges it, by its word; every other word clears by itself."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The numbers of a site, in nanoseconds and millimetres."""

    dwell_ns: int = 100 * MS
    least_frames: int = 3
    lease_ns: int = 80 * MS
    oldest_ns: int = 60 * MS
    longest_gap_ns: int = 60 * MS
    longest_silence_ns: int = 500 * MS
    shortest_on_ns: int = 0
    shortest_off_ns: int = 0
    cycles_a_minute: int = 120
    lower_mm: float = -1.0
    upper_mm: float = 3.0
    margin_mm: float = 0.2


@dataclass(kw_only=True)
class Oracle:
    """What must be so; ``run`` holds when each frame of the present run was received and captured, both in ns."""

    rules: Rules
    is_armed: bool = False
    is_faulted: bool = False
    is_on: bool = False
    run: list[tuple[int, int]] = field(default_factory=list)
    last: tuple[int, int] | None = None
    went_on_ns: list[int] = field(default_factory=list)
    went_off_ns: int | None = None
    was_short: bool = False
    has_model: bool = True
    has_zero: bool = True
    shows_patient: bool = False
    """Of the newest frame: its motion was measured, whatever else forbids the beam."""

    @property
    def state(self) -> str:
        """The word for it."""
        if self.is_faulted:
            return "fault"
        if not self.is_armed:
            return "disarmed"
        if self.is_on:
            return "beam_on"
        return "dwell" if self.run else "hold"

    def frame(
        self,
        *,
        received_ns: int,
        captured_ns: int,
        now_ns: int,
        level_mm: float | None,
        is_disorder: bool = False,
        is_nonsense: bool = False,
    ) -> None:
        """A frame decided on at ``now_ns``.

        A level of None is one that may not be trusted. ``is_disorder``: times or numbers do not run on; that faults
        whatever else there is. ``is_nonsense``: what was measured cannot be; that faults where it is looked at, which
        it is not in a frame that is too late to be decided on anyway.
        """
        before, self.last = self.last, (received_ns, captured_ns)
        rules, age_ns = self.rules, now_ns - received_ns
        gap_ns = 0 if before is None else max(received_ns - before[0], captured_ns - before[1])
        is_late = age_ns > rules.oldest_ns or gap_ns > rules.longest_gap_ns
        is_lapsed = self.is_on and before is not None and now_ns >= before[0] + rules.lease_ns
        if is_disorder or age_ns > rules.longest_silence_ns or (is_nonsense and not is_late):
            self.fault(now_ns)
        elif is_late or is_lapsed or not self._is_inside(level_mm):
            self.hold(now_ns)
        elif self.is_armed:
            self.run.append((received_ns, captured_ns))
            if not self.is_on and self._has_dwelt() and self._may_switch(now_ns):
                self.is_on = True
                self.went_on_ns.append(now_ns)

    def silence(self, now_ns: int) -> None:
        """Nothing came until now."""
        if self.last is not None and now_ns - self.last[0] > self.rules.longest_silence_ns:
            self.fault(now_ns)
        else:
            self.hold(now_ns)

    def hold(self, now_ns: int) -> None:
        """Something forbids the beam: off at once, and all that counted is forgotten."""
        self.run.clear()
        if self.is_on:
            self.is_on = False
            self.went_off_ns = now_ns
            self.was_short = now_ns - self.went_on_ns[-1] < self.rules.shortest_on_ns

    def fault(self, now_ns: int) -> None:
        """Something that latches."""
        self.hold(now_ns)
        self.is_armed, self.is_faulted = False, True

    def arm(self, now_ns: int) -> None:
        """A person arms: from now on frames count."""
        self.hold(now_ns)
        self.is_armed = not self.is_faulted

    def refuses_arming(self, now_ns: int) -> bool:
        """Whether a person who arms now is refused, before anything is touched."""
        can_decide = self.has_model and self.has_zero and self.shows_patient
        is_fresh = self.last is not None and now_ns - self.last[0] <= self.rules.longest_gap_ns + self.rules.oldest_ns
        return self.is_faulted or self.is_armed or not (can_decide and is_fresh)

    def refuses_reference(self) -> bool:
        """Whether a reference set now is refused: the newest frame has to show the patient."""
        return self.has_model and not self.shows_patient

    def disarm(self, now_ns: int) -> None:
        """A person disarms, or the frames are over, or the model is another."""
        self.hold(now_ns)
        self.is_armed = False

    def acknowledge(self, now_ns: int) -> None:
        """A person has seen the fault; that arms no one."""
        self.hold(now_ns)
        self.is_faulted = False

    def _is_inside(self, level_mm: float | None) -> bool:
        if level_mm is None:
            return False
        margin_mm = 0.0 if self.run else self.rules.margin_mm
        return self.rules.lower_mm + margin_mm <= level_mm <= self.rules.upper_mm - margin_mm

    def _has_dwelt(self) -> bool:
        """Whether the run is long enough by count, by the host's clock and by the camera's."""
        (first_received_ns, first_captured_ns), (received_ns, captured_ns) = self.run[0], self.run[-1]
        needed_ns = self.rules.dwell_ns + (self.rules.shortest_on_ns if self.was_short else 0)
        lasted_ns = min(received_ns - first_received_ns, captured_ns - first_captured_ns)
        return len(self.run) >= self.rules.least_frames and lasted_ns >= needed_ns

    def _may_switch(self, now_ns: int) -> bool:
        recently = [at_ns for at_ns in self.went_on_ns if now_ns - at_ns < MINUTE_NS]
        rested = self.went_off_ns is None or now_ns - self.went_off_ns >= self.rules.shortest_off_ns
        return rested and len(recently) < self.rules.cycles_a_minute
