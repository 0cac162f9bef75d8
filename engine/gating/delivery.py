"""How late a live camera's frames are, and how much later they may be than the clocks show (ADR 0025).

The lag of a frame is its host time minus its device time. Against the least lag so far it is the frame's delay, as far
as the two clocks run alike. A device clock that is fast by as much as a backlog grows keeps the lag constant, so clocks
alone do not show the age of a picture. A frame that was received while the driver had none waiting was fresh; since the
last such frame, the pictures can have aged unseen by the greatest error of a clock and no more.

The rate of a camera's clock against the host's, estimated over minutes.

Estimated from the lag of frames, which is host time minus device time: it changes by the difference of the two clocks
and by a delay that grows or shrinks. The least lag of ten seconds is nearly free of jitter. A rate counts only if two
minutes in a row agree on it, because one step of the delay, as by a busier host, looks like a rate within one minute.
"""

from dataclasses import dataclass

from engine.core.clock import CLOCK_DRIFT, NS_PER_MS, NS_PER_S, NS_PER_US
from engine.core.frames import Measurement
from engine.core.replacing import replace
from engine.gating.limits import MAX_UNCHECKED_US

MAX_RATE_ERROR_PPM = 200.0
"""Greatest rate at which the two clocks may differ: twice what quartz does."""

SPAN_NS = 10 * NS_PER_S
SPANS = 6
"""Spans of one estimate: a minute."""
GREATEST_CLOCK_ERROR = 0.01
"""Greatest relative error of a camera's clock that is believed possible."""
FRESH_NS = 50 * NS_PER_MS
"""A frame is fresh if no frame waited in the driver this long before its receipt; more than a period of 30 frames/s."""
LONGEST_GAP_NS = NS_PER_S
"""Time without frames after which the rate of the clocks is estimated anew: a returned camera continues by guess."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """What the frames so far show about their delivery.

    Attributes
    ----------
    least_lag_ns
        Least lag so far, plus the allowed drift of the clocks since [ns].
    fresh_ns
        When the last frame was received that is known to have been fresh [ns]; None if there is none.
    rate
        Rate of the device's clock.
    """

    least_lag_ns: int
    fresh_ns: int | None
    rate: ClockRate


def lag_of(frame: Measurement) -> int:
    """Return host time minus device time of a frame [ns]; the two clocks have different origins."""
    return frame.received_ns - frame.timestamp_us * NS_PER_US


def followed_delivery(before: Delivery | None, frame: Measurement, elapsed_ns: int) -> Delivery:
    """Return the summary with one more frame.

    ``before`` is None for a first frame, or a device that restarted its clock; ``elapsed_ns`` is the host time since
    the last frame.
    """
    lag_ns = lag_of(frame)
    fresh_ns = frame.received_ns if _is_fresh(frame) else None
    if before is None:
        return Delivery(least_lag_ns=lag_ns, fresh_ns=fresh_ns, rate=followed_rate(None, frame.received_ns, lag_ns))
    drift_ns = int(CLOCK_DRIFT * max(elapsed_ns, 0))
    rate = None if elapsed_ns > LONGEST_GAP_NS else before.rate
    return Delivery(
        least_lag_ns=min(lag_ns, before.least_lag_ns + drift_ns),
        fresh_ns=before.fresh_ns if fresh_ns is None else fresh_ns,
        rate=followed_rate(rate, frame.received_ns, lag_ns),
    )


def is_age_known(delivery: Delivery, received_ns: int) -> bool:
    """Return whether a frame that is known to have been fresh was received within the time that every check has."""
    since_ns = None if delivery.fresh_ns is None else received_ns - delivery.fresh_ns
    return since_ns is not None and since_ns <= MAX_UNCHECKED_US * NS_PER_US


def unseen_ageing_ms(delivery: Delivery, frame: Measurement) -> float | None:
    """Return how much older ``frame`` may be than its lag shows [ms]; None if no frame is known to have been fresh."""
    if delivery.fresh_ns is None:
        return None
    since_ns = max(frame.received_ns - delivery.fresh_ns, 0)
    return (GREATEST_CLOCK_ERROR + CLOCK_DRIFT) * since_ns / NS_PER_MS


def _is_fresh(frame: Measurement) -> bool:
    empty_ns = frame.queue_empty_ns
    return empty_ns is not None and 0 <= frame.received_ns - empty_ns <= FRESH_NS
