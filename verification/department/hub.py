"""The hub: PostgreSQL in the hub's namespace, on a small disk of its own, with a database a room."""

import contextlib
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from service.storage.audit import Verification
from service.storage.audit.check import check_chain
from service.storage.database.engine import Database
from tests.support.database.postgres import PostgresServer
from tests.support.department.replication import (
    HUB_SETTINGS,
    answer,
    arrive,
    complete,
    counts,
    end_subscription,
    hub_database,
    subscribe,
)
from verification.department.network import Network
from verification.department.room import AS_A_SITE, Room
from verification.load.usage import usage_of

DISK = "1500m"
SETTINGS = HUB_SETTINGS | AS_A_SITE | {"wal_receiver_timeout": "3s", "wal_retrieve_retry_interval": "1s"}


class Hub:
    """The hub of the campaign, and the rooms' databases there."""

    def __init__(self, network: Network, disk: Path) -> None:
        self._disk = disk
        self.server = PostgresServer(SETTINGS, network=network.words, root=disk)
        self.names: dict[int, str] = {}

    def follow(self, room: Room) -> None:
        """Follow a room into a new database."""
        self.names[room.number] = name = hub_database(self.server)
        subscribe(self.server, name, room.server, room.name, host=room.cable.address)
        complete(self.server, name)

    def leave(self, room: Room) -> None:
        """End the subscription of a room without asking the room."""
        end_subscription(self.server, self.names[room.number])

    def has_all(self, room: Room) -> None:
        """Wait until the hub has what the room has."""
        arrive(self.server, self.names[room.number], room.server, room.name)

    def rows(self, room: Room) -> int:
        """Count the rows of a room's copy."""
        return total(counts(self.server, self.names[room.number]))

    def size_bytes(self) -> int:
        """Return the size of the rooms' databases."""
        sizes = (answer(self.server, name, "SELECT pg_database_size(current_database())") for name in self.all_names)
        return sum(int(str(one)) for one in sizes)

    @property
    def all_names(self) -> list[str]:
        """The databases that follow a room."""
        return list(self.names.values())

    def processor_s(self) -> float:
        """Return the processor time of the server's processes that live [s]."""
        return usage_of(self.server.process_id).processor_s

    def verify(self, room: Room) -> Verification:
        """Verify a room's audit in its copy."""
        with closing(Database(self.server.url(self.names[room.number]))) as database:
            return check_chain(database)

    def fill_disk(self) -> None:
        """Leave no byte on the hub's disk."""
        with contextlib.suppress(OSError), (self._disk / "filler").open("wb") as filler:
            while True:
                filler.write(bytes(1024 * 1024))
                filler.flush()

    def free_disk(self) -> None:
        """Take away what filled it; a server that ended over it is started again."""
        (self._disk / "filler").unlink()
        if not self.server.is_running:
            self.server.start()


def total(count: str) -> int:
    """Sum up what count.sql prints."""
    return sum(int(line.split("|")[1]) for line in count.splitlines() if line)


@contextmanager
def small_disk(place: Path) -> Iterator[Path]:
    """Mount a file system of the hub's own. Needs root."""
    place.mkdir()
    place.chmod(0o755)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tidegate-hub", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)
