"""A department in trouble: ``python -m verification.department --seconds 20 [--write]``.

Two real services with PostgreSQL and a session each, and a hub in a network of its own that follows them. Prints what
each room did during each event, and what arrived afterwards; exit code 0 when no room was affected and every row
arrived, 1 otherwise, 2 without root. ``--part costs`` prints what following costs instead, and what sixteen
rooms would cost.
"""

import argparse
import contextlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import typer

from tests.support.generated_sections import write_parts
from tests.support.repository import ROOT
from tests.support.temporary_folder import temporary_root
from verification.campaign.command_line import WRONG_USAGE, bounded, revision_of_the_code
from verification.department import costs
from verification.department.events import Department, Outcome, RoomMeanwhile
from verification.department.hub import Hub, small_disk
from verification.department.network import network
from verification.department.room import Room
from verification.load.recording import base_folder

DOCUMENT = ROOT / "docs/3-operate/department.md"
Parts = dict[str, Callable[[], str]]
MOST_SECONDS = 20
"""A session ends with its recording of 40 s, of which arming and an event's beginning take some."""


def main(arguments: list[str] | None = None) -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(prog="python -m verification.department", description=__doc__)
    parser.add_argument(
        "--seconds", type=bounded(5, MOST_SECONDS), default=MOST_SECONDS, help="how long each event lasts"
    )
    parser.add_argument("--part", choices=["outages", "costs"], default="outages")
    parser.add_argument("--write", action="store_true", help="put its table into docs/3-operate/department.md")
    asked = parser.parse_args(arguments)
    if os.geteuid() != 0:
        typer.echo("verification.department: networks need root: nothing is run", err=True)
        return WRONG_USAGE
    with department(asked.seconds) as made:
        tables, is_red = (_costs(made), False) if asked.part == "costs" else _outages(made)
    typer.echo("\n\n".join(make() for make in tables.values()))
    if asked.write:
        write_parts(DOCUMENT, tables)
    return int(is_red)


def _outages(made: Department) -> tuple[Parts, bool]:
    outcomes = []
    for event in made.events():
        outcomes.append(made.happen(event))
        typer.echo(line_of(outcomes[-1]))
    said = _said(f" --seconds {made.seconds:g}")
    return {"outages": lambda: said + table(outcomes)}, any(outcome.is_red for outcome in outcomes)


def _costs(made: Department) -> Parts:
    time.sleep(costs.SETTLE_S)  # what learning left to be cleaned up is no room's idling
    idle = costs.measure(made.hub, made.rooms, lambda: time.sleep(costs.IDLE_S))

    def sessions() -> None:
        for _ in range(costs.SESSIONS):
            made.new_sessions()
            time.sleep(made.seconds)

    gating = costs.measure(made.hub, made.rooms, sessions)
    said = _said(f" --part costs --seconds {made.seconds:g}")
    return {"costs": lambda: said + costs.table(idle, gating)}


@contextlib.contextmanager
def department(seconds: float) -> Iterator[Department]:
    """Make two rooms that have learned, and a hub that follows them."""
    with contextlib.ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tidegate-rooms-", dir=temporary_root())))
        place.chmod(0o755)
        net = stack.enter_context(network(2))
        hub = Hub(net, stack.enter_context(small_disk(place / "hub")))
        stack.callback(hub.server.close)
        rooms = []
        for number, cable in enumerate(net.cables, 1):
            room = Room(number, place / f"room-{number}", base_folder(), cable)
            stack.callback(room.stack.close)
            hub.follow(room)
            rooms.append(room)
        yield Department(hub, rooms, seconds=seconds)


def table(outcomes: list[Outcome]) -> str:
    """Return the failure table for the document."""
    heads = ["event", "room 1", "room 2", "rows written", "lacking at its end"]
    heads += ["all there after, s", "slot lost", "audit"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *(line_of(outcome) for outcome in outcomes)])


def line_of(outcome: Outcome) -> str:
    """Return one row of the table."""
    words = [outcome.event, *(_room(room) for room in outcome.rooms)]
    lacked = "-" if outcome.lacked is None else str(outcome.lacked)
    words += [str(outcome.written), lacked, f"{outcome.caught_up_s:.1f}"]
    words += ["yes" if outcome.is_lost else "no", "intact" if outcome.are_intact else "**broken**"]
    return "| " + " | ".join(words) + " |"


def _room(room: RoomMeanwhile | None) -> str:
    if room is None:
        return "killed"
    holds = ", ".join(room.other_holds) or "no hold but the breathing's"
    return f"{room.frames} frames, beam on {room.beams} times, {holds}"


def _said(options: str) -> str:
    command = f"python -m verification.department{options}"
    return f"`{command}` at {revision_of_the_code()}, {os.cpu_count()} cores, load {os.getloadavg()[2]:.1f}:\n\n"


if __name__ == "__main__":
    sys.exit(main())
