"""The rate of a camera's clock against the host's, estimated over minutes.

Estimated from the lag of frames, which is host time minus device time: it changes by the difference of the two clocks
and by a delay that grows or shrinks. The least lag of ten seconds is nearly free of jitter. A rate counts only if two
minutes in a row agree on it, because one step of the delay, as by a busier host, looks like a rate within one minute.
"""

from dataclasses import dataclass

from engine.core.clock import NS_PER_S
from engine.core.replacing import replace

MAX_RATE_ERROR_PPM = 200.0
"""Greatest rate at which the two clocks may differ: twice what quartz does."""

SPAN_NS = 10 * NS_PER_S
SPANS = 6
"""Spans of one estimate: a minute."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockRate:
    """The least lags of the last two minutes.

    Attributes
    ----------
    begun_ns
        When the present span began [ns, host].
    least_lag_ns
        Least lag of the present span [ns].
    least_lags_ns
        Least lags of the spans before [ns], the newest last.
    """

    begun_ns: int
    least_lag_ns: int
    least_lags_ns: tuple[int, ...] = ()

    @property
    def error_ppm(self) -> float | None:
        """How much faster than the host's the device's clock runs, by the lower of two minutes' estimates [ppm].

        0 where the two have opposite signs, None before there are two.
        """
        least = self.least_lags_ns
        if len(least) <= 2 * SPANS:
            return None
        minutes = (least[-1] - least[-1 - SPANS], least[-1 - SPANS] - least[-1 - 2 * SPANS])
        lower_ns = min(minutes, key=abs) if (minutes[0] < 0) is (minutes[1] < 0) else 0
        return -1e6 * lower_ns / (SPANS * SPAN_NS)


def followed_rate(before: ClockRate | None, received_ns: int, lag_ns: int) -> ClockRate:
    """Return the estimate with one more frame; ``before`` is None at the first frame and after a gap."""
    if before is None:
        return ClockRate(begun_ns=received_ns, least_lag_ns=lag_ns)
    if received_ns - before.begun_ns < SPAN_NS:
        return before if lag_ns >= before.least_lag_ns else replace(before, least_lag_ns=lag_ns)
    least = (*before.least_lags_ns, before.least_lag_ns)[-2 * SPANS - 1 :]
    return ClockRate(begun_ns=before.begun_ns + SPAN_NS, least_lag_ns=lag_ns, least_lags_ns=least)
