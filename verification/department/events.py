"""What happens to the department, and what the rooms did meanwhile."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from tests.support.department.replication import answer, counts, execute
from verification.department.hub import Hub, total
from verification.department.room import Reading, Room

OF_STORING = frozenset(
    {"audit_behind", "recorder_behind", "disk_low", "service_silent", "watchdog", "engine_failed", "engine_stopped"}
)
"""Holds that a hub could cause. Late or missing frames are this machine's: two rooms share its cores."""
SEGMENTS = 6
"""Log segments of 16 MB, more than the bound of the campaign's rooms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomMeanwhile:
    """A room during an event: None where it was killed itself."""

    frames: int
    beams: int
    other_holds: tuple[str, ...]

    @property
    def is_affected(self) -> bool:
        """Whether a hold has to do with what is stored, or with the service that stores it."""
        return any(hold.partition(" ")[0] in OF_STORING for hold in self.other_holds)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One event: rows that the rooms wrote and how many the hub lacked at its end, and how long it then took."""

    event: str
    seconds: float
    rooms: tuple[RoomMeanwhile | None, ...]
    written: int
    lacked: int | None
    caught_up_s: float
    is_lost: bool
    are_intact: bool

    @property
    def is_red(self) -> bool:
        """Whether a room was affected, or its audit is broken in the copy. What does not arrive ends the campaign."""
        rooms = [room for room in self.rooms if room is not None]
        return not self.are_intact or any(not room.beams or room.is_affected for room in rooms)


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """What is done before and after the wait."""

    name: str
    begin: Callable[[], None] = field(default=lambda: None)
    end: Callable[[], None] = field(default=lambda: None)
    killed: Room | None = None


class Department:
    """Two rooms and the hub, and all events in turn."""

    def __init__(self, hub: Hub, rooms: Sequence[Room], *, seconds: float) -> None:
        self.hub, self.rooms, self.seconds = hub, rooms, seconds

    def events(self) -> list[Event]:
        """Every event, in order: each leaves the department whole."""
        first, second = self.rooms
        return [
            Event(name="nothing"),
            Event(name="hub killed", begin=self.hub.server.kill, end=self.hub.server.start),
            Event(name="network of room 1 cut", begin=first.cable.cut, end=first.cable.mend),
            Event(name="hub's disk full", begin=self._fill_disk, end=self.hub.free_disk),
            Event(name="room 1 cut beyond its bound", begin=self._exceed, end=self._again),
            Event(name="room 2 killed", begin=second.kill, end=second.come_back, killed=second),
        ]

    def happen(self, event: Event) -> Outcome:
        """Let one event happen, for as long as asked, and wait until the hub has everything."""
        self.new_sessions()
        for room in self.rooms:
            self.hub.has_all(room)
        before_rows = self._written()
        event.begin()
        spared = [room for room in self.rooms if room is not event.killed]
        before = {room.number: room.read() for room in spared}
        began_s = time.monotonic()
        time.sleep(self.seconds)
        after = {room.number: room.read() for room in spared}
        seconds = time.monotonic() - began_s
        is_lost = self._is_lost(spared)
        lacked = None if event.killed is not None else self._lacked(before_rows)
        event.end()
        written = self._written() - before_rows
        began_s = time.monotonic()
        for room in self.rooms:
            self.hub.has_all(room)
        caught_up_s = time.monotonic() - began_s
        rooms = tuple(_meanwhile(before.get(room.number), after.get(room.number)) for room in self.rooms)
        return Outcome(
            event=event.name,
            seconds=seconds,
            rooms=rooms,
            written=written,
            lacked=lacked,
            caught_up_s=caught_up_s,
            is_lost=is_lost,
            are_intact=all(self.hub.verify(room).is_intact for room in self.rooms),
        )

    def _written(self) -> int:
        return sum(total(counts(room.server, room.name)) for room in self.rooms)

    def _lacked(self, before_rows: int) -> int:
        """Count what the hub lacks: of one that is away all that was written since the event began."""
        there = sum(self.hub.rows(room) for room in self.rooms) if self.hub.server.is_running else before_rows
        return self._written() - there

    def new_sessions(self) -> None:
        """End the rooms' sessions, and begin and arm new ones."""
        for room in self.rooms:
            if room.session_id:
                room.end_session()
            room.begin_session()

    def _fill_disk(self) -> None:
        self.hub.fill_disk()
        self.new_sessions()

    def _is_lost(self, spared: Sequence[Room]) -> bool:
        lost = "SELECT count(*) FROM pg_replication_slots WHERE wal_status = 'lost'"
        return any(answer(room.server, room.name, lost) for room in spared)

    def _exceed(self) -> None:
        """Cut room 1 off until it keeps no more log for the hub."""
        room = self.rooms[0]
        room.cable.cut()
        query = "SELECT count(*) FROM pg_replication_slots WHERE active"
        while answer(room.server, room.name, query):
            time.sleep(0.2)
        for _ in range(SEGMENTS):
            execute(room.server, room.name, "CREATE TABLE filler ()", "DROP TABLE filler", "SELECT pg_switch_wal()")
        execute(room.server, room.name, "CHECKPOINT")

    def _again(self) -> None:
        """Follow room 1 into a new database, as docs/3-operate/department.md says."""
        room = self.rooms[0]
        room.cable.mend()
        self.hub.leave(room)
        execute(room.server, room.name, f"SELECT pg_drop_replication_slot('{self.hub.names[room.number]}')")
        self.hub.follow(room)


def _meanwhile(before: Reading | None, after: Reading | None) -> RoomMeanwhile | None:
    if before is None or after is None:
        return None
    other = {name: after.other_holds[name] - before.other_holds[name] for name in after.other_holds}
    return RoomMeanwhile(
        frames=round(after.frames - before.frames),
        beams=round(after.beams - before.beams),
        other_holds=tuple(f"{name} {count:.0f}" for name, count in other.items() if count),
    )
