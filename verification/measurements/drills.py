"""The five drills of daily QA against every kind of receiver, as a table.

Run: ``python -m verification.measurements.drills [--repeats 20]``. Each receiver is a process of its own behind the
real protocol, and follows the rules of docs/3-operate/beam.md; the simulated line has none. A drill is one way out of
beam-on: a hold, a lease that is not renewed, a fault, an engine that stops deciding, a heartbeat that stands still. A
set of drills that a busy machine spoilt is done again, at most `ATTEMPTS` times; the table says how often. Exits with 1
where a drill never succeeded.
"""

import argparse
import contextlib
import sys
import threading
from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from engine.beam.heartbeat_drill import DrilledReceiver
from engine.beam.line import BeamLine
from engine.beam.simulated import SimulatedBeamLine, SimulatedReceiver
from engine.core.clock import NS_PER_S, MonotonicClock
from engine.qa.drill import DRILLS, drill_line
from engine.qa.inputs import BeamInput
from engine.qa.results import QaFigure
from tests.support.beam.receivers import drilled_part, receiver
from verification.campaign.command_line import bounded, revision_of_the_code

KINDS = ("simulated", "tcp", "rtu", "lcus", "lcus-text", "numato")
PULSE_MS = 200.0
MOST_REPEATS = 200
ATTEMPTS = 5


@contextlib.contextmanager
def part_of(kind: str) -> Iterator[tuple[BeamLine, DrilledReceiver]]:
    """Start a receiver of a kind; yield the line to it, and the receiver with its second input."""
    if kind == "simulated":
        clock = MonotonicClock()
        line = SimulatedBeamLine(clock)
        yield line, DrilledReceiver(name=kind, line=line, second_input=SimulatedReceiver(line, clock))
        return
    with receiver(kind) as far:
        yield drilled_part(far)


def drilled(kind: str, repeats: int) -> tuple[dict[str, QaFigure], int]:
    """Return the figures of the drills against a kind, and how many sets were done until none failed."""
    figures: dict[str, QaFigure] = {}
    for attempt in range(1, ATTEMPTS + 1):
        with part_of(kind) as (line, far):
            given = BeamInput(
                line=line,
                clock=MonotonicClock(),
                wait_ns=lambda span_ns: threading.Event().wait(span_ns / NS_PER_S),
                pulse_ms=PULSE_MS,
                repeats=repeats,
                receivers=(far,),
            )
            figures = {figure.code: figure for figure in drill_line(given, lambda _done: None)}
        if all(figures[_code(name)].value is not None for name in DRILLS if _code(name) in figures):
            return figures, attempt
    return figures, ATTEMPTS


def _code(drill: str) -> str:
    return f"fail_safe_{drill}_ms"


def main(arguments: list[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m verification.measurements.drills", description=__doc__)
    parser.add_argument("--repeats", type=bounded(5, MOST_REPEATS), default=20)
    repeats = parser.parse_args(arguments).repeats
    table = Table(title=f"slowest of {repeats}, ms, at {revision_of_the_code()}")
    for column in ("receiver", *DRILLS, "sets"):
        table.add_column(column)
    console, failures = Console(width=None if sys.stdout.isatty() else 160), []
    for kind in KINDS:
        figures, sets = drilled(kind, repeats)
        cells = [figures.get(_code(name)) for name in DRILLS]
        failures += [
            f"{kind}, {name}: {'not drilled' if one is None else one.detail}"
            for name, one in zip(DRILLS, cells, strict=True)
            if one is None or one.value is None
        ]
        table.add_row(
            kind, *("-" if one is None or one.value is None else f"{one.value:.0f}" for one in cells), str(sets)
        )
    console.print(table)
    for line in failures:
        console.print(line, style="red", markup=False)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
