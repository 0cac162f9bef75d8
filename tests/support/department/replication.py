"""Two PostgreSQL servers with the department's own files: a room that publishes, a hub that follows it."""

import os
import pwd
import subprocess
from pathlib import Path

from sqlalchemy import URL, text

from service.storage.database.engine import Database
from tests.support.database.postgres import OWNER, PostgresServer
from tests.support.repository import ROOT
from tests.support.waiting import eventually

FILES = ROOT / "docker/department/replication"
ROLE, PASSWORD = "tidegate_replica", "of the replication"
ROOM_SETTINGS = {"wal_level": "logical", "max_slot_wal_keep_size": "64MB"}
HUB_SETTINGS = {"wal_retrieve_retry_interval": "100ms", "max_logical_replication_workers": "12"}
HUB_SETTINGS |= {"max_worker_processes": "16"}


class ScriptError(Exception):
    """A file of the department was refused; the text is psql's."""


def run_file(server: PostgresServer, database: str, name: str, **variables: str) -> str:
    """Run a file of docker/department/replication by psql, as its head says; return what it prints."""
    given = [word for item in variables.items() for word in ("-v", "=".join(item))]
    where = ["-h", str(server.folder), "-p", str(server.port), "-U", OWNER, "-d", database]
    words = ["psql", "-X", "-q", "-A", "-t", *where, *given, "-f", str(FILES / name)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ScriptError(done.stderr)
    return done.stdout


def execute(server: PostgresServer, database: str, *statements: str) -> None:
    """Run statements one by one, each as a transaction of its own."""
    with_database = Database(server.url(database))
    try:
        with with_database.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            for statement in statements:
                connection.execute(text(statement))
    finally:
        with_database.close()


def answer(server: PostgresServer, database: str, query: str) -> object:
    """Return the first column of the first row; None where there is none."""
    with_database = Database(server.url(database))
    try:
        with with_database.connect() as connection:
            return connection.scalar(text(query))
    finally:
        with_database.close()


def publish(room: PostgresServer, database: str) -> None:
    """Publish a room's records, as room.sql does, and give the role its password."""
    run_file(room, database, "room.sql")
    execute(room, database, f"ALTER ROLE {ROLE} PASSWORD '{PASSWORD}'")


def subscribe(
    hub: PostgresServer, name: str, room: PostgresServer, database: str, *, host: str = "127.0.0.1", tls: str = ""
) -> None:
    """Let an empty database of the hub follow a room; returns before its rows are copied."""
    secret = _password_file(hub)
    where = f"host={host} port={room.port} dbname={database} user={ROLE} passfile={secret} connect_timeout=2 {tls}"
    run_file(hub, name, "hub.sql", room=where)


def complete(hub: PostgresServer, name: str) -> None:
    """Wait until the rows of before are copied, and put the hub's triggers back."""

    def is_copied() -> bool:
        left = "SELECT count(*) FROM pg_subscription_rel WHERE srsubstate <> 'r'"
        return answer(hub, name, left) == 0

    eventually(is_copied, pause_s=0.1, detail=lambda: (hub.folder / "log").read_text()[-2000:])
    run_file(hub, name, "hub-complete.sql")


def counts(server: PostgresServer, database: str) -> str:
    """Return what count.sql prints."""
    return run_file(server, database, "count.sql")


def arrive(hub: PostgresServer, name: str, room: PostgresServer, database: str) -> str:
    """Wait until the hub has what the room has; return the count."""
    eventually(
        lambda: counts(hub, name) == counts(room, database),
        pause_s=0.1,
        detail=lambda: f"room:\n{counts(room, database)}\nhub:\n{counts(hub, name)}",
    )
    return counts(hub, name)


def hub_database(hub: PostgresServer, revision: str = "head") -> str:
    """Make the hub's database for one room, with Tidegate's tables."""
    url = hub.empty()
    database = Database(url)
    database.migrate(revision)
    database.close()
    assert url.database is not None
    return url.database


def name_of(url: URL) -> str:
    """Return the database's name."""
    assert url.database is not None
    return url.database


def _password_file(hub: PostgresServer) -> Path:
    secret = hub.folder / "pgpass"
    secret.write_text(f"*:*:*:{ROLE}:{PASSWORD}\n")
    secret.chmod(0o600)
    if os.getuid() == 0:
        owner = pwd.getpwnam("postgres")
        os.chown(secret, owner.pw_uid, owner.pw_gid)
    return secret


def end_subscription(hub: PostgresServer, name: str) -> None:
    """Remove a subscription without asking the room for its slot."""
    execute(
        hub,
        name,
        f"ALTER SUBSCRIPTION {name} DISABLE",
        f"ALTER SUBSCRIPTION {name} SET (slot_name = NONE)",
        f"DROP SUBSCRIPTION {name}",
    )


class FollowedRoom:
    """One room's database and its copy at the hub, with the steps of docs/3-operate/department.md."""

    def __init__(self, room: PostgresServer, hub: PostgresServer, *, hub_revision: str = "head") -> None:
        self.room, self.hub = room, hub
        self.url = room.migrated()
        self.name = name_of(self.url)
        self.database = Database(self.url)
        self.hub_name = hub_database(hub, hub_revision)

    def follow(self) -> None:
        """Publish, subscribe, and wait until the rows of before are copied."""
        publish(self.room, self.name)
        subscribe(self.hub, self.hub_name, self.room, self.name)
        complete(self.hub, self.hub_name)

    def arrive(self) -> str:
        """Wait until the hub has all rows of the room; return the count."""
        return arrive(self.hub, self.hub_name, self.room, self.name)

    def counts(self) -> tuple[str, str]:
        """Return the room's count and the hub's."""
        return counts(self.room, self.name), counts(self.hub, self.hub_name)

    def at_hub(self) -> Database:
        """Open the hub's copy; the caller closes it."""
        return Database(self.hub.url(self.hub_name))

    def slot(self, column: str) -> object:
        """Return a column of the slot's row at the room."""
        return answer(
            self.room, self.name, f"SELECT {column} FROM pg_replication_slots WHERE slot_name = '{self.hub_name}'"
        )

    def close(self) -> None:
        """Close the room's database and remove it, with what the hub left of its slot."""
        self.database.close()
        execute(
            self.room,
            "postgres",
            "SELECT pg_terminate_backend(active_pid) FROM pg_replication_slots WHERE active",
            f"DO $$ BEGIN PERFORM pg_drop_replication_slot(slot_name) FROM pg_replication_slots "
            f"WHERE database = '{self.name}' AND NOT active; END $$",
        )
        self.room.drop(self.url)
        self.hub.drop(self.hub.url(self.hub_name))
