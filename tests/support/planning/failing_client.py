"""A client that injects each fault in turn: the number of calls of a fraction depends on its waits."""

import random
from collections import deque
from collections.abc import Iterator

from lab.simulated_tps.delivery import FAULTS, FaultInjectingClient
from service.client import AnsweredCall, LiveMessage, SentCall

SENT_TWICE = "sent twice"
EVERY = 2
READ_SLOWLY_AT, BROKEN_AT = 30, 60
NOW, NEVER = 0.0, 1.0
EVERY_FAULT = frozenset({*FAULTS, "read slowly", "stream broken"})


class ScriptedRandom(random.Random):
    """Returns the queued draws, then values that inject no fault."""

    def __init__(self) -> None:
        super().__init__()
        self.draws: deque[float] = deque()
        self.kinds: deque[str] = deque(FAULTS)

    def random(self) -> float:
        return self.draws.popleft() if self.draws else NEVER

    def choice(self, _kinds):
        self.kinds.rotate(-1)
        return self.kinds[-1]


class ScriptedFaultClient(FaultInjectingClient):
    """Every second attempt fails, each kind in turn; the stream is read slowly once and breaks once."""

    def __init__(self, base_url: str, *, key: str, operator: str) -> None:
        super().__init__(base_url, key=key, operator=operator, seed=0)
        self._random: ScriptedRandom = ScriptedRandom()
        self._attempts = 0

    def _once(self, call: SentCall) -> AnsweredCall:
        self._attempts += 1
        is_possible = call.is_repeatable or self._random.kinds[0] != SENT_TWICE
        if self._attempts % EVERY == 0 and is_possible:
            self._random.draws.append(NOW)
        return super()._once(call)

    def live(self, **options) -> Iterator[LiveMessage]:
        for number, message in enumerate(super().live(**options)):
            yield message
            if number == READ_SLOWLY_AT:
                self._random.draws.extend((NOW, NOW))  # the second one is how long: as short as can be
            if number == BROKEN_AT:
                self._random.draws.extend((NEVER, NOW))
