"""Drive one session of a fraction as a record-and-verify system and its therapist do.

The next call follows from the received frames, never from the answer of the previous call: a call whose answer was lost
is repeated only after the stream has shown its effect. A frame may have waited in a buffer longer than its `age_ms`
states, so calls that can lead to beam need a fresh frame that is newer than the last call. Hold and stop are sent
whatever the age of the frame.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Literal

from lab.simulated_tps.delivery import US_PER_S, BeamClock, DeliveredBeams, Seen
from lab.simulated_tps.prescription import FractionEndedError, SessionOverError, TpsError
from service.client import Gap, LiveMessage, ProblemError, Sample, SessionDetail, TidegateClient, UnreachableError

HeadSide = Literal["top", "bottom", "left", "right"]
OPEN = frozenset({"created", "running"})
RETRY_STATUSES = frozenset({409, 429, 503})
BEFORE_FIRST_FRAME = -1
MAX_AGE_S = 1.0
"""Limit of a frame's age at sending plus its transport time; no call that can lead to beam follows an older frame."""


SIGNED_BECAUSE = "simulation: the position was not checked by other means"
"""Reason of the simulated therapist for a position beyond the tolerance, or that is not determined."""
PRESENCE_S = 1.0
"""Period in which a person's page reports their presence."""


class Stage(StrEnum):
    """Stages of a session, as the progress bar names them."""

    LEARNING = "learning"
    REFERENCE = "waiting for the reference"
    ARMING = "arming"
    DELIVERING = "delivering"
    BETWEEN = "between beams"
    DONE = "done"


@dataclass(frozen=True, slots=True, kw_only=True)
class DeliverySettings:
    """Times and limits of the simulated treatment.

    Attributes
    ----------
    between_s
        Pause between two beams, for the gantry.
    settle_s
        Time after a call in which its effect is awaited, before the next call.
    beam_timeout_s
        Longest time without beam before the fraction ends.
    restart_wait_s
        Longest wait for an unreachable service.
    max_acknowledgements
        Faults that are acknowledged in one fraction.
    """

    between_s: float = 1.0
    settle_s: float = 1.5
    beam_timeout_s: float = 120.0
    restart_wait_s: float = 60.0
    max_acknowledgements: int = 10


@dataclass(slots=True)
class FractionEvents:
    """Counts of holds, faults, acknowledgements and lost answers over all sessions of a fraction."""

    holds: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    acknowledged: int = 0
    lost_answers: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """State of the progress bar; ``share`` is 0 to 1."""

    stage: Stage
    share: float
    detail: str


class SessionDriver:
    """Runs one session from start to stop.

    Attributes
    ----------
    clock
        Beam-on time and frames received over the stream.
    announced_missing
        Number of samples that the service reported as dropped or not resent.
    """

    def __init__(
        self,
        session_id: str,
        *,
        tps: TidegateClient,
        therapist: TidegateClient | None,
        delivered: DeliveredBeams,
        events: FractionEvents,
        settings: DeliverySettings,
        on_progress: Callable[[Progress], None],
        head_direction: HeadSide | None = None,
        sleep: Callable[[float], None] = time.sleep,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.session_id = session_id
        self.clock = BeamClock()
        self.announced_missing = 0
        self._tps = tps
        self._therapist = therapist
        self._delivered = delivered
        self._events = events
        self._settings = settings
        self._on_progress = on_progress
        self._sleep = sleep
        self._now_s = now_s
        self._head_direction = head_direction
        self._least_offset_s = float("inf")
        self._is_fresh = False
        self._stage = Stage.LEARNING
        self._name: str | None = None
        self._has_held = False
        self._is_hold_seen = False
        self._last_call_s = self._last_presence_s = float("-inf")
        self._progress_us: int | None = None
        self._last_reason: str | None = None
        self._steps: dict[Stage, Callable[[Sample], None]] = {
            Stage.LEARNING: self._learn,
            Stage.REFERENCE: self._reference,
            Stage.ARMING: self._arm,
            Stage.DELIVERING: self._deliver,
            Stage.BETWEEN: self._between,
        }

    def run(self) -> None:
        """Start the session, deliver the remaining beams, stop it; on an error hold the beam and stop."""
        try:
            self._begin()
            for message in self._messages():
                self._handle(message)
                if self._stage is Stage.DONE:
                    break
        except SessionOverError:
            raise
        except BaseException:
            self._hold_and_stop()
            raise
        self._tps.stop(self.session_id)

    def _begin(self) -> None:
        """Start the session; if the answer was lost, read the session's status and start again if it is not running."""
        try:
            self._tps.start(self.session_id)
        except UnreachableError:
            self._events.lost_answers += 1
            if self._await_service()["status"] == "created":
                self._begin()

    def _hold_and_stop(self) -> None:
        """Hold the beam and stop the session; the stop is sent even if the hold fails."""
        for leave in (self._tps.hold, self._tps.stop):
            with suppress(ProblemError, UnreachableError):
                leave(self.session_id)

    def _messages(self) -> Iterator[LiveMessage]:
        """Follow the stream; if the connection fails, wait for the service and resume after the last received frame."""
        while True:
            last = self.clock.last
            after_frame = BEFORE_FIRST_FRAME if last is None else last.frame_index
            try:
                yield from self._tps.live(session_id=self.session_id, after_frame=after_frame, form="full")
            except UnreachableError:
                self._await_service()

    def _await_service(self) -> SessionDetail:
        """Wait until the service answers; raise SessionOverError if the session has ended, TpsError on time-out."""
        waited_s = 0.0
        while True:
            try:
                session = self._tps.read_session(self.session_id)
            except UnreachableError as error:
                if waited_s >= self._settings.restart_wait_s:
                    message = f"the service has been gone for {waited_s:g} s"
                    raise TpsError(message) from error
                self._sleep(1.0)
                waited_s += 1.0
            else:
                if session["status"] not in OPEN:
                    raise SessionOverError(session["status"], session["status_detail"])
                return session

    def _handle(self, message: LiveMessage) -> None:
        """Count every frame; act only on full samples of this running session."""
        if message["type"] == "idle":
            self._await_service()
        if message["type"] == "dropped":
            self.announced_missing += message["skipped"]
        if message["type"] == "gap":
            self.announced_missing += self._gap(message)
        if message["type"] != "sample" or message["session_id"] != self.session_id:
            return
        on = message["line_on"]
        seen = Seen(frame_index=message["frame_index"], timestamp_us=message["timestamp_us"], is_on=on)
        self._delivered.add(self.clock.note(seen))
        if message["form"] != "full":
            return
        self._note_reason(message)
        if message["session_status"] != "running":
            self._await_service()
            return
        self._on_progress(self._progress(message))
        self._is_fresh = self._age_s(message) <= MAX_AGE_S
        self._be_present()
        self._steps[self._stage](message)

    def _be_present(self) -> None:
        """Report, as the page of a therapist who takes part, that they see fresh frames."""
        if self._therapist is None or not self._is_fresh or self._now_s() - self._last_presence_s < PRESENCE_S:
            return
        self._last_presence_s = self._now_s()
        with suppress(ProblemError, UnreachableError):  # lost: if it persists, the beam is held
            self._therapist.note_presence(self.session_id)

    def _age_s(self, sample: Sample) -> float:
        """Return the age of a frame at its arrival [s]; the clock offset is the least that any message has shown."""
        offset_s = self._now_s() - datetime.fromisoformat(sample["sent_at"]).timestamp()
        self._least_offset_s = min(self._least_offset_s, offset_s)
        return sample["age_ms"] / 1e3 + offset_s - self._least_offset_s

    def _gap(self, gap: Gap) -> int:
        """Return the number of frames in a gap; they are not resent."""
        last = gap["to_frame"]
        return 0 if last is None else last - gap["from_frame"] + 1

    def _note_reason(self, sample: Sample) -> None:
        """Count each hold and fault of the armed gate once, at its first frame."""
        reason = sample["hold_reason"] if sample["gate"] in {"hold", "fault"} else None
        if reason is not None and reason != self._last_reason:
            self._events.holds[reason] += 1
        self._last_reason = reason

    def _learn(self, sample: Sample) -> None:
        if sample["state"] == "measuring":
            self._enter(Stage.REFERENCE, sample)

    def _reference(self, sample: Sample) -> None:
        """Set the reference as the therapist, who sees the proposal; without one, wait until a person has set it."""
        if sample["state"] != "measuring" or not self._is_settled:
            return
        therapist, session = self._therapist, self._await_service()
        if session.get("has_reference"):
            self._position(session, sample)
            return
        proposed = next((one for one in session.get("reference_proposals", []) if one["at"] == "end_exhale"), None)
        if therapist is None or proposed is None:
            self._last_call_s = self._now_s()  # look again after a while
            self._check_timeout(sample)
            return
        self._call_once(
            lambda: therapist.set_reference(self.session_id, level_seen=proposed["level"], setup_confirmed=True)
        )

    def _position(self, session: SessionDetail, sample: Sample) -> None:
        """Sign the position as the therapist, where a later fraction needs it; else wait until a person has."""
        therapist, check = self._therapist, session.get("position_check")
        if check is None or check["status"] in {"first_fraction", "signed"}:
            self._enter(Stage.ARMING, sample)
            return
        number = check["reference_number"]
        if therapist is None or check["status"] != "unsigned" or number is None:
            self._last_call_s = self._now_s()  # look again after a while
            self._check_timeout(sample)
            return
        reason = "" if check["is_within"] else SIGNED_BECAUSE
        self._call_once(lambda: therapist.sign_position(self.session_id, reference_number=number, reason=reason))

    def _arm(self, sample: Sample) -> None:
        """Arm; repeat the call only if later frames show a disarmed gate."""
        if sample["gate"] == "fault":
            self._handle_fault(sample)
        elif sample["is_armed"]:
            self._enter(Stage.DELIVERING, sample)
        else:
            self._call_once(lambda: self._tps.arm(self.session_id, head_direction=self._head_direction))
            self._check_timeout(sample)

    def _deliver(self, sample: Sample) -> None:
        if sample["gate"] == "fault":
            self._handle_fault(sample)
        elif not sample["is_armed"]:
            self._handle_disarming(sample)
        elif self._delivered.is_beam_done:
            self._end_beam(sample)
        elif self._has_held and self._name in sample["operator_holds"]:
            self._call_once(lambda: self._tps.release(self.session_id))
        else:
            if sample["line_on"]:
                self._progress_us = sample["timestamp_us"]
            self._check_timeout(sample)

    def _end_beam(self, sample: Sample) -> None:
        """Hold the beam at the end of the planned beam-on time."""
        try:
            self._tps.hold(self.session_id)
            self._name = self._name or self._tps.me()["name"]
        except UnreachableError:
            self._await_service()
            return  # the next frame repeats the hold
        self._has_held, self._is_hold_seen = True, False
        self._enter(Stage.DONE if self._delivered.is_last else Stage.BETWEEN, sample)

    def _between(self, sample: Sample) -> None:
        """Wait ``between_s``, then go on to the next beam; release only this system's own hold."""
        if sample["gate"] == "fault":
            self._delivered.next_beam()
            self._enter(Stage.ARMING, sample)
        elif self._name in sample["operator_holds"]:
            self._is_hold_seen = True
            if self._since_us(sample) >= self._settings.between_s * US_PER_S:
                self._delivered.next_beam()
                self._enter(Stage.DELIVERING, sample)
        elif sample["operator_holds"]:
            self._check_timeout(sample)  # another operator holds and has to release
        elif self._is_hold_seen or self._since_us(sample) >= self._settings.settle_s * US_PER_S:
            self._end_beam(sample)

    def _since_us(self, sample: Sample) -> int:
        return sample["timestamp_us"] - (self._progress_us or 0)

    def _handle_fault(self, sample: Sample) -> None:
        """Acknowledge as the therapist, up to the limit; without a therapist the fraction ends."""
        reason = sample["hold_reason"] or "unknown"
        if not self._events.faults or self._stage is not Stage.ARMING:
            self._events.faults.append(reason)
        therapist = self._therapist
        if therapist is None:
            message = f"the fault {reason} is latched, and a key may not acknowledge it: a person has to"
            raise FractionEndedError(message)
        if self._events.acknowledged >= self._settings.max_acknowledgements:
            message = f"{self._events.acknowledged} faults were acknowledged, the limit; another followed: {reason}"
            raise FractionEndedError(message)
        if self._call_once(lambda: therapist.acknowledge(self.session_id)):
            self._events.acknowledged += 1
        self._enter(Stage.ARMING, sample)

    def _handle_disarming(self, sample: Sample) -> None:
        """Arm again if a therapist takes part; otherwise end the fraction, because the disarming had a cause."""
        if not self._is_settled:
            return
        if self._therapist is None:
            message = f"the gate was disarmed: {sample['hold_detail'] or sample['hold_text'] or 'no reason given'}"
            raise FractionEndedError(message)
        self._enter(Stage.ARMING, sample)

    def _call_once(self, action: Callable[[], SessionDetail]) -> bool:
        """Send a call that is never repeated automatically; return whether the service confirmed it."""
        if not self._is_settled:
            return False
        try:
            action()
        except UnreachableError:
            self._events.lost_answers += 1
            self._await_service()
            return False
        except ProblemError as problem:
            if problem.status not in RETRY_STATUSES:
                raise
            return False
        finally:
            self._last_call_s = self._now_s()
        return True

    @property
    def _is_settled(self) -> bool:
        """Whether the current frame shows the effect of the last call: fresh, and ``settle_s`` after the call."""
        return self._is_fresh and self._now_s() - self._last_call_s >= self._settings.settle_s

    def _check_timeout(self, sample: Sample) -> None:
        if self._since_us(sample) > self._settings.beam_timeout_s * US_PER_S:
            message = f"no beam for {self._settings.beam_timeout_s:g} s: {sample['hold_text'] or sample['gate']}"
            raise FractionEndedError(message)

    def _enter(self, stage: Stage, sample: Sample) -> None:
        self._stage = stage
        self._progress_us = sample["timestamp_us"]

    def _progress(self, sample: Sample) -> Progress:
        training = sample["training"]
        if training is not None:
            return Progress(stage=Stage.LEARNING, share=training["share"], detail=training["note"])
        beam = next(one for one in self._delivered.reports() if one.number == self._delivered.current.number)
        share = min(1.0, beam.delivered_s / beam.planned_s)
        detail = f"{beam.name} {beam.delivered_s:.1f}/{beam.planned_s:.1f} s {sample['hold_text'] or ''}"
        return Progress(stage=self._stage, share=share, detail=detail)
