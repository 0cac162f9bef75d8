"""How old pictures get before a growing backlog in a camera's driver is noticed, and by what.

`python -m tests.campaigns.measurements.ageing` prints, for five errors of the camera's clock and the backlogs that hide
best behind each, the age of the pictures when the gate first refuses one, within an hour: by the rule of version 0.1
(the least lag ages by 500 ppm and nothing else), by the present checks, and by the present checks where the evidence of
an empty queue is wrong, because frames wait where the capture thread does not see it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

import typer

from tests.support.gating.ageing import Seen, watched

HOUR_S = 3_600.0
QUIET_S = 10.0
"""Time without a backlog, at first."""

CLOCK_ERRORS = (-5e-3, -1e-4, 0.0, 1e-4, 5e-3)
SLOW_PPM, EARLIER_PPM = 30.0, 490.0
"""A backlog of a little more than 100 ms in an hour, and the fastest that the earlier rule followed."""

EARLIER_DRIFT, EARLIER_LAG_MS = 5e-4, 100.0


@dataclass(frozen=True, kw_only=True)
class Noticed:
    """When a stream was first refused, how old its picture was, and the reason; its age at the end where it was not."""

    at_s: float
    age_ms: float
    by: str | None

    @property
    def text(self) -> str:
        """In a cell of the table."""
        return f"{self.age_ms:6.0f} ms " + (f"{self.at_s:6.1f} s {self.by}" if self.by else "not within the time")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One clock and one backlog."""

    clock_error: float
    growth: float
    earlier: Noticed
    present: Noticed
    fooled: Noticed


def growths(clock_error: float) -> list[float]:
    """Return the backlogs, as shares of the time: slow ones, and those that hide behind a clock that is fast."""
    slow = [1e-6 * SLOW_PPM, 1e-6 * EARLIER_PPM]
    return slow + [clock_error + one for one in slow if clock_error > 0.0]


def rows(seconds: float = HOUR_S) -> Iterator[Row]:
    """Measure every clock with every backlog."""
    for error in CLOCK_ERRORS:
        for growth in growths(error):
            yield Row(
                clock_error=error,
                growth=growth,
                earlier=_earlier(error, growth, seconds),
                present=_present(_stream(error, growth, seconds, is_proof_wrong=False)),
                fooled=_present(_stream(error, growth, seconds, is_proof_wrong=True)),
            )


def _waiting(growth: float) -> Callable[[float], float]:
    return lambda at_s: 1e3 * growth * max(at_s - QUIET_S, 0.0)


def _stream(error: float, growth: float, seconds: float, *, is_proof_wrong: bool) -> Iterator[Seen]:
    return watched(seconds=seconds, clock_error=error, waiting_ms=_waiting(growth), is_proof_wrong=is_proof_wrong)


def _present(stream: Iterator[Seen]) -> Noticed:
    one = None
    for one in stream:
        if one.verdict is not None:
            return Noticed(at_s=one.at_s, age_ms=one.age_ms, by=f"{one.reason}")
    assert one is not None
    return Noticed(at_s=one.at_s, age_ms=one.age_ms, by=None)


def _earlier(error: float, growth: float, seconds: float) -> Noticed:
    """Apply the rule of version 0.1: the lag against the least one, which ages."""
    waiting_ms, step_s, least_ms, at_s = _waiting(growth), 0.15, 0.0, 0.0
    for index in range(int(seconds / step_s)):
        at_s = index * step_s
        lag_ms = waiting_ms(at_s) - 1e3 * error * at_s
        least_ms = min(lag_ms, least_ms + 1e3 * EARLIER_DRIFT * step_s)
        if lag_ms - least_ms > EARLIER_LAG_MS:
            return Noticed(at_s=at_s, age_ms=waiting_ms(at_s), by="frame_late")
    return Noticed(at_s=at_s, age_ms=waiting_ms(at_s), by=None)


def main(seconds: Annotated[float, typer.Option(min=30.0, help="Length of each stream [s].")] = HOUR_S) -> None:
    """Print the table."""
    columns = ("clock error", "growth", "earlier rule", "now", "now, wrong evidence")
    typer.echo(f"{columns[0]:>11} {columns[1]:>12}   {columns[2]:<28} {columns[3]:<28} {columns[4]}")
    for row in rows(seconds):
        typer.echo(
            f"{1e2 * row.clock_error:+9.2f} % {1e3 * row.growth:7.2f} ms/s   "
            f"{row.earlier.text:<28} {row.present.text:<28} {row.fooled.text}"
        )


if __name__ == "__main__":
    typer.run(main)
