"""A client on a bad day: answers lost, calls sent twice, a stream that breaks, a reader that dawdles; by a seed."""

import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Literal

from service.client import AnsweredCall, LiveMessage, SentCall, TidegateClient

BREAKS_A_MESSAGE = 1 / 400
DAWDLES_A_MESSAGE = 1 / 300
DAWDLE_S = (0.3, 1.5)
TROUBLES = ("answer lost", "never sent", "sent twice")
TROUBLE_SHARE = 0.3
RETRIES = 8
"""One in five attempts fails: so many one after another that only a bad day without end is given up."""


class UnrulyClient(TidegateClient):
    """Does to its own calls what networks and programs do to them; `counts` says what it did."""

    def __init__(
        self,
        base_url: str,
        *,
        seed: int,
        key: str | None = None,
        operator: str | None = None,
        ca_file: str | None = None,
        dawdle: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(base_url, key=key, operator=operator, ca_file=ca_file, retries=RETRIES)
        self._random = random.Random(seed)  # noqa: S311 - trouble, not secrets
        self._dawdle = dawdle
        self.counts: Counter[str] = Counter()

    def _once(self, call: SentCall) -> AnsweredCall:
        if self._random.random() >= TROUBLE_SHARE:
            return super()._once(call)
        trouble = self._random.choice(TROUBLES)
        if trouble == "sent twice" and not call.is_repeatable:
            return super()._once(call)
        self.counts[trouble] += 1
        if trouble == "never sent":
            raise ConnectionResetError("chaos: the request was never sent")
        super()._once(call)
        if trouble == "sent twice":
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
        """Follow the stream, and fall out of it now and then."""
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
                if self._random.random() < DAWDLES_A_MESSAGE:
                    self.counts["read slowly"] += 1
                    self._dawdle(self._random.uniform(*DAWDLE_S))
                if self._random.random() < BREAKS_A_MESSAGE:
                    self.counts["stream broken"] += 1
                    break
