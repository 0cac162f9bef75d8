"""One session of a fraction, watched and driven as a record-and-verify system and its therapist would.

What is done next follows from the frames that are seen, never from whether a call was answered: a call whose answer was
lost is not sent again before the stream has shown what became of it. A frame may have waited in a buffer for longer
than its message says: nothing that could lead to a beam is done because of an old one, or of one from before the last
call. What takes the beam away is done whatever the frame's age.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum

from service.client import Gap, LiveMessage, ProblemError, Sample, SessionDetail, TidegateClient, UnreachableError
from service.tps.delivery import US_PER_S, BeamClock, EndExhale, Seen
from service.tps.errors import FractionEndedError, SessionOverError, TpsError
from service.tps.ledger import Ledger

OPEN = frozenset({"created", "running"})
NOT_NOW = frozenset({409, 429, 503})
BEFORE_THE_FIRST = -1
OLDEST_S = 1.0
"""Age at sending, and time on the way: nothing that could lead to a beam is done because of an older frame."""


class Stage(StrEnum):
    """Where a session stands, for whoever treats."""

    LEARNING = "learning"
    REFERENCE = "waiting for end-exhale"
    ARMING = "arming"
    DELIVERING = "delivering"
    BETWEEN = "between beams"
    DONE = "done"


@dataclass(frozen=True, slots=True, kw_only=True)
class Manner:
    """How the simulated people treat."""

    exhale_watch_s: float = 4.0
    between_s: float = 1.0
    settle_s: float = 1.5
    patience_s: float = 120.0
    restart_wait_s: float = 60.0
    most_acknowledgements: int = 10


@dataclass(slots=True)
class Story:
    """What happened on the way; one for all sessions of a fraction."""

    holds: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    acknowledged: int = 0
    lost_answers: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """What a bar shows."""

    stage: Stage
    share: float
    detail: str


class Stretch:
    """Runs one session, from its start to its end.

    Attributes
    ----------
    clock
        What was seen of it.
    told_missing
        How many samples the service said that it left out.
    """

    def __init__(
        self,
        session_id: str,
        *,
        tps: TidegateClient,
        therapist: TidegateClient | None,
        ledger: Ledger,
        story: Story,
        manner: Manner,
        tell: Callable[[Progress], None],
        sleep: Callable[[float], None] = time.sleep,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.session_id = session_id
        self.clock = BeamClock()
        self.told_missing = 0
        self._tps = tps
        self._therapist = therapist
        self._ledger = ledger
        self._story = story
        self._manner = manner
        self._tell = tell
        self._sleep = sleep
        self._now_s = now_s
        self._least_offset_s = float("inf")
        self._is_fresh = False
        self._stage = Stage.LEARNING
        self._exhale = EndExhale(watch_s=manner.exhale_watch_s)
        self._held_as: str | None = None
        self._is_hold_seen = False
        self._pressed_s = float("-inf")
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
        """Start the session, deliver what the ledger asks for, stop it; on every way out the beam is held first."""
        try:
            self._begin()
            for message in self._messages():
                self._hear(message)
                if self._stage is Stage.DONE:
                    break
        except SessionOverError:
            raise
        except BaseException:
            self._leave()
            raise
        self._tps.stop(self.session_id)

    def _begin(self) -> None:
        """Start; where the answer was lost the session says whether it runs."""
        try:
            self._tps.start(self.session_id)
        except UnreachableError:
            self._story.lost_answers += 1
            if self._await_service()["status"] == "created":
                self._begin()

    def _leave(self) -> None:
        """Hold, and stop whatever became of the hold; no more can be done from here."""
        for leave in (self._tps.hold, self._tps.stop):
            with suppress(ProblemError, UnreachableError):
                leave(self.session_id)

    def _messages(self) -> Iterator[LiveMessage]:
        """Follow the stream; where it is broken for long, wait for the service and go on behind the last frame."""
        while True:
            last = self.clock.last
            after_frame = BEFORE_THE_FIRST if last is None else last.frame_index
            try:
                yield from self._tps.live(session_id=self.session_id, after_frame=after_frame, form="full")
            except UnreachableError:
                self._await_service()

    def _await_service(self) -> SessionDetail:
        """Wait until the service answers again, and look whether the session still runs."""
        waited_s = 0.0
        while True:
            try:
                session = self._tps.read_session(self.session_id)
            except UnreachableError as error:
                if waited_s >= self._manner.restart_wait_s:
                    message = f"the service has been gone for {waited_s:g} s"
                    raise TpsError(message) from error
                self._sleep(1.0)
                waited_s += 1.0
            else:
                if session["status"] not in OPEN:
                    raise SessionOverError(session["status"], session["status_detail"])
                return session

    def _hear(self, message: LiveMessage) -> None:
        """Count every frame; act only on those that are live, and new."""
        if message["type"] == "idle":
            self._await_service()
        if message["type"] == "dropped":
            self.told_missing += message["skipped"]
        if message["type"] == "gap":
            self.told_missing += self._gap(message)
        if message["type"] != "sample" or message["session_id"] != self.session_id:
            return
        on = message["line_on"]
        seen = Seen(frame_index=message["frame_index"], timestamp_us=message["timestamp_us"], is_on=on)
        self._ledger.add(self.clock.note(seen))
        if message["form"] != "full":
            return
        self._note_reason(message)
        if message["session_status"] != "running":
            self._await_service()
            return
        self._tell(self._progress(message))
        self._is_fresh = self._age_s(message) <= OLDEST_S
        self._steps[self._stage](message)

    def _age_s(self, sample: Sample) -> float:
        """Tell how old a frame is here and now: the two clocks differ by what the quickest message took."""
        offset_s = self._now_s() - datetime.fromisoformat(sample["sent_at"]).timestamp()
        self._least_offset_s = min(self._least_offset_s, offset_s)
        return sample["age_ms"] / 1e3 + offset_s - self._least_offset_s

    def _gap(self, gap: Gap) -> int:
        """Return how many frames the service says that it will not send again."""
        last = gap["to_frame"]
        return 0 if last is None else last - gap["from_frame"] + 1

    def _note_reason(self, sample: Sample) -> None:
        """Count the holds of an armed gate, each once."""
        reason = sample["hold_reason"] if sample["gate"] in {"hold", "fault"} else None
        if reason is not None and reason != self._last_reason:
            self._story.holds[reason] += 1
        self._last_reason = reason

    def _learn(self, sample: Sample) -> None:
        if sample["state"] == "measuring":
            self._go_to(Stage.REFERENCE, sample)

    def _reference(self, sample: Sample) -> None:
        is_measured = sample["state"] == "measuring"
        is_due = is_measured and self._exhale.is_reached(sample["timestamp_us"], sample["whole_mm"])
        if is_due and self._press(lambda: self._tps.set_reference(self.session_id)):
            self._go_to(Stage.ARMING, sample)

    def _arm(self, sample: Sample) -> None:
        """Arm, and look at the frames for whether it is; ask again only when they say that it is not."""
        if sample["gate"] == "fault":
            self._face_fault(sample)
        elif sample["is_armed"]:
            self._go_to(Stage.DELIVERING, sample)
        else:
            self._press(lambda: self._tps.arm(self.session_id))
            self._check_patience(sample)

    def _deliver(self, sample: Sample) -> None:
        if sample["gate"] == "fault":
            self._face_fault(sample)
        elif not sample["is_armed"]:
            self._face_disarming(sample)
        elif self._ledger.is_beam_done:
            self._end_beam(sample)
        elif self._held_as is not None and sample["operator_hold"] == self._held_as:
            self._press(lambda: self._tps.release(self.session_id))
        else:
            if sample["line_on"]:
                self._progress_us = sample["timestamp_us"]
            self._check_patience(sample)

    def _end_beam(self, sample: Sample) -> None:
        """Hold: the beam has had its time."""
        try:
            held = self._tps.hold(self.session_id)
        except UnreachableError:
            self._await_service()
            return  # the next frame asks again
        self._held_as = None if held["gate"] is None else held["gate"]["operator_hold"]
        self._is_hold_seen = False
        self._go_to(Stage.DONE if self._ledger.is_last else Stage.BETWEEN, sample)

    def _between(self, sample: Sample) -> None:
        """Wait as long as it takes to turn the gantry, then let go of our own hold and nobody else's."""
        if self._held_as is None:  # the answer was given before a frame could show the hold
            self._held_as = sample["operator_hold"]
        if sample["gate"] == "fault":
            self._ledger.next_beam()
            self._go_to(Stage.ARMING, sample)
        elif self._held_as is not None and sample["operator_hold"] == self._held_as:
            self._is_hold_seen = True
            if self._since_us(sample) >= self._manner.between_s * US_PER_S:
                self._ledger.next_beam()
                self._go_to(Stage.DELIVERING, sample)
        elif sample["operator_hold"] is not None:
            self._check_patience(sample)  # somebody else holds: it is theirs to release
        elif self._is_hold_seen or self._since_us(sample) >= self._manner.settle_s * US_PER_S:
            self._end_beam(sample)

    def _since_us(self, sample: Sample) -> int:
        return sample["timestamp_us"] - (self._progress_us or 0)

    def _face_fault(self, sample: Sample) -> None:
        """Let a person who has looked acknowledge; without one the fraction ends here."""
        reason = sample["hold_reason"] or "unknown"
        if not self._story.faults or self._stage is not Stage.ARMING:
            self._story.faults.append(reason)
        therapist = self._therapist
        if therapist is None:
            message = f"the fault {reason} is latched, and no key may acknowledge: a person has to"
            raise FractionEndedError(message)
        if self._story.acknowledged >= self._manner.most_acknowledgements:
            message = f"{self._story.acknowledged} faults were acknowledged, and here is another: {reason}"
            raise FractionEndedError(message)
        if self._press(lambda: therapist.acknowledge(self.session_id)):
            self._story.acknowledged += 1
        self._go_to(Stage.ARMING, sample)

    def _face_disarming(self, sample: Sample) -> None:
        """Arm again only where a person is here: whoever or whatever disarmed had a reason."""
        if not self._is_settled:
            return
        if self._therapist is None:
            message = f"the gate was disarmed: {sample['hold_detail'] or sample['hold_text'] or 'nobody says why'}"
            raise FractionEndedError(message)
        self._go_to(Stage.ARMING, sample)

    def _press(self, action: Callable[[], SessionDetail]) -> bool:
        """Ask for what is never repeated by itself, once the frames show the need; say whether it was done."""
        if not self._is_settled:
            return False
        try:
            action()
        except UnreachableError:
            self._story.lost_answers += 1
            self._await_service()
            return False
        except ProblemError as problem:
            if problem.status not in NOT_NOW:
                raise
            return False
        finally:
            self._pressed_s = self._now_s()
        return True

    @property
    def _is_settled(self) -> bool:
        """Whether the frame of now shows what became of the last call: it is new, and the call is further back."""
        return self._is_fresh and self._now_s() - self._pressed_s >= self._manner.settle_s

    def _check_patience(self, sample: Sample) -> None:
        if self._since_us(sample) > self._manner.patience_s * US_PER_S:
            message = f"no beam for {self._manner.patience_s:g} s: {sample['hold_text'] or sample['gate']}"
            raise FractionEndedError(message)

    def _go_to(self, stage: Stage, sample: Sample) -> None:
        self._stage = stage
        self._progress_us = sample["timestamp_us"]

    def _progress(self, sample: Sample) -> Progress:
        training = sample["training"]
        if training is not None:
            return Progress(stage=Stage.LEARNING, share=training["share"], detail=training["note"])
        beam = next(one for one in self._ledger.reports() if one.number == self._ledger.current.number)
        share = min(1.0, beam.delivered_s / beam.planned_s)
        detail = f"{beam.name} {beam.delivered_s:.1f}/{beam.planned_s:.1f} s {sample['hold_text'] or ''}"
        return Progress(stage=self._stage, share=share, detail=detail)
