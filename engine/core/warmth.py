"""How warm a camera is: in the first minutes after its start its readings drift by millimetres.

Sensor, projector and housing follow their heat with a time constant: a camera that runs approaches its final readings
exponentially, and one that does not run leaves them at the same rate.
"""

import math

COLD_LEFT = 0.1
"""A camera counts as warm when this share of its drift is left: 1.2 mm of the 12 mm that users report at most."""
LONGEST_STEP_S = 1.0
"""Two frames farther apart than this have a camera between them that does not run [s]."""


class Warmth:
    """The warmth of one camera; owned by one thread.

    Parameters
    ----------
    warm_up_s
        How long a cold camera takes until a tenth of its drift is left [s]; 0 for one that needs none.
    cold_share
        Share of its drift that is left, 1 for a cold camera, 0 for one that has run for long.
    """

    def __init__(self, warm_up_s: float, cold_share: float = 1.0) -> None:
        self.warm_up_s = warm_up_s
        self._constant_s = warm_up_s / math.log(1.0 / COLD_LEFT)
        self.cold_share = cold_share if warm_up_s > 0.0 else 0.0
        self._last_ns: int | None = None

    def run(self, seconds: float) -> None:
        """Let it run for so long."""
        if self._constant_s > 0.0:
            self.cold_share *= math.exp(-max(seconds, 0.0) / self._constant_s)

    def rest(self, seconds: float) -> None:
        """Let it not run for so long."""
        if self._constant_s > 0.0:
            self.cold_share = 1.0 - (1.0 - self.cold_share) * math.exp(-max(seconds, 0.0) / self._constant_s)

    def frame(self, received_ns: int) -> None:
        """Take the host time of a frame: it ran since the frame before, unless that is more than a second ago."""
        last_ns, self._last_ns = self._last_ns, received_ns
        if last_ns is None:
            return
        step_s = (received_ns - last_ns) / 1e9
        (self.run if step_s <= LONGEST_STEP_S else self.rest)(step_s)

    @property
    def left_s(self) -> float:
        """How long it still has to run until it is warm [s]; 0 where it is."""
        if self.cold_share <= COLD_LEFT:
            return 0.0
        return self._constant_s * math.log(self.cold_share / COLD_LEFT)
