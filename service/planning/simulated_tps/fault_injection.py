"""A client that injects faults by a seed: lost answers, repeated calls, a broken stream, slow reading."""

import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Literal

from service.client import AnsweredCall, LiveMessage, SentCall, TidegateClient

BREAK_PROBABILITY = 1 / 400
SLOW_READ_PROBABILITY = 1 / 300
SLOW_READ_S = (0.3, 1.5)
FAULTS = ("answer lost", "never sent", "sent twice")
FAULT_PROBABILITY = 0.3
RETRIES = 8
"""One attempt in five fails: this many consecutive failures are practically impossible."""


class FaultInjectingClient(TidegateClient):
    """Injects faults into its own calls; `counts` holds the number of each kind."""

    def __init__(
        self,
        base_url: str,
        *,
        seed: int,
        key: str | None = None,
        operator: str | None = None,
        ca_file: str | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(base_url, key=key, operator=operator, ca_file=ca_file, retries=RETRIES)
        self._random = random.Random(seed)  # noqa: S311 - not cryptographic
        self._sleep = sleep
        self.counts: Counter[str] = Counter()

    def _once(self, call: SentCall) -> AnsweredCall:
        if self._random.random() >= FAULT_PROBABILITY:
            return super()._once(call)
        fault = self._random.choice(FAULTS)
        if fault == "sent twice" and not call.is_repeatable:
            return super()._once(call)
        self.counts[fault] += 1
        if fault == "never sent":
            raise ConnectionResetError("chaos: the request was never sent")
        super()._once(call)
        if fault == "sent twice":
            return super()._once(call)
        raise ConnectionResetError("chaos: the answer was lost")

    def live(
        self,
        *,
        session_id: str | None = None,
        after_frame: int | None = None,
        rate_hz: float | None = None,
        form: Literal["full", "thin"] = "thin",
        silence_s: float = 5.0,
        reconnects: int = 8,
    ) -> Iterator[LiveMessage]:
        """Follow the stream; break the connection and read slowly at random, then resume."""
        last = after_frame
        while True:
            stream = super().live(
                session_id=session_id,
                after_frame=last,
                rate_hz=rate_hz,
                form=form,
                silence_s=silence_s,
                reconnects=reconnects,
            )
            for message in stream:
                yield message
                if message["type"] == "sample" and message["session_id"] == session_id:
                    last = message["frame_index"]
                if self._random.random() < SLOW_READ_PROBABILITY:
                    self.counts["read slowly"] += 1
                    self._sleep(self._random.uniform(*SLOW_READ_S))
                if self._random.random() < BREAK_PROBABILITY:
                    self.counts["stream broken"] += 1
                    break
