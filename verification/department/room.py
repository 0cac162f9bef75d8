"""One room: PostgreSQL, a real service, and a session whose beam goes on and off with every breath."""

import contextlib
import signal
from dataclasses import dataclass, field
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from tests.support.database.postgres import PostgresServer
from tests.support.department.replication import ROLE, ROOM_SETTINGS, execute, name_of, publish
from verification.department.network import NET, Cable
from verification.load.service import LoadError, Service, learn, served, start_session, stop_session

QUICK = {
    "TIDEGATE_TRAINING_MIN_FRAMES": "150",
    "TIDEGATE_TRAINING_MIN_CYCLES": "3",
    "TIDEGATE_TRAINING_MIN_SECONDS": "8",
}
RECORDING = "recording.oni"
ATTEMPTS = 3
AS_A_SITE = {"full_page_writes": "on", "fsync": "on", "synchronous_commit": "on", "autovacuum": "on"}
"""What a site's PostgreSQL does, and the tests' does not: it costs log."""
AS_A_SITE |= {"wal_sender_timeout": "3s"}
OF_BREATHING = frozenset({"outside_window", "dwell"})
"""Holds that breathing makes in this window; any other one is named in the table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What a room's metrics say at one moment; ``scrape_bytes`` is how long they are."""

    frames: float
    beams: float
    other_holds: dict[str, float]
    scrape_bytes: int


@dataclass
class Room:
    """A room of the campaign; closed by its stack."""

    number: int
    place: Path
    volunteer: Path
    cable: Cable
    stack: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    def __post_init__(self) -> None:
        self.place.mkdir(parents=True)
        settings = ROOM_SETTINGS | AS_A_SITE | {"listen_addresses": f"127.0.0.1,{self.cable.address}"}
        self.server = PostgresServer(settings)
        self.stack.callback(self.server.close)
        with (self.server.folder / "data" / "pg_hba.conf").open("a", encoding="utf-8") as rules:
            rules.write(f"host all {ROLE} {NET}.0.0/16 scram-sha-256\n")
        self.url = self.server.migrated()
        publish(self.server, name_of(self.url))
        execute(self.server, "postgres", "SELECT pg_reload_conf()")
        self.begin_service()
        self.given = learn(self.service, self.volunteer, self.volunteer / RECORDING)
        self.session_id = ""

    @property
    def name(self) -> str:
        """The database's name."""
        return name_of(self.url)

    def begin_service(self) -> None:
        """Start the service, again after a kill."""
        url = self.server.tcp_url(self.name).set(drivername="postgresql").render_as_string(hide_password=False)
        environment = QUICK | {"TIDEGATE_DATABASE_URL": url, "TIDEGATE_ROOM": f"Room-{self.number}"}
        made = served(self.place, self.volunteer, environment=environment)
        self.service: Service = self.stack.enter_context(made)

    def begin_session(self) -> None:
        """Begin a session, and arm it; once more where a busy machine took the whole recording for that."""
        for attempt in range(ATTEMPTS):
            try:
                self.session_id = start_session(self.service, self.volunteer / RECORDING, self.given)
            except LoadError:
                if attempt + 1 == ATTEMPTS:
                    raise
            else:
                return

    def end_session(self) -> None:
        """End the session, and wait until all of it is written."""
        stop_session(self.service, self.session_id)

    def kill(self) -> None:
        """End the service and its database at once, as a power cut does."""
        self.service.process.send_signal(signal.SIGKILL)
        self.service.process.wait()
        self.server.kill()

    def come_back(self) -> None:
        """Start both again, and a new session."""
        self.server.start()
        self.begin_service()
        self.begin_session()

    def read(self) -> Reading:
        """Read the metrics."""
        with self.service.client() as client:
            answer = client.get("/metrics")
            answer.raise_for_status()
        values = {
            (sample.name, *sorted(sample.labels.items())): sample.value
            for family in text_string_to_metric_families(answer.text)
            for sample in family.samples
        }
        holds = {dict(key[1:])["reason"]: value for key, value in values.items() if key[0] == "tidegate_holds_total"}
        beams = [
            value
            for key, value in values.items()
            if key[0] == "tidegate_gate_transitions_total" and ("to_state", "beam_on") in key[1:]
        ]
        frames = [value for key, value in values.items() if key[0] == "tidegate_frames_total"]
        return Reading(
            frames=sum(frames),
            beams=sum(beams),
            other_holds={name: value for name, value in holds.items() if name not in OF_BREATHING},
            scrape_bytes=len(answer.content),
        )
