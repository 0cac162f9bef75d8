"""The demo's person: put into its data folder while no service runs there, and logged in like anybody else."""

from pathlib import Path

from service.access.names import name_key
from service.access.passwords import Argon2Hashing
from service.access.people import Change, PeopleDesk
from service.access.permissions import Role
from service.access.store import AccessStore
from service.db.engine import Database
from service.db.preparing import prepare
from service.folder_lock import alone_in

ROLES = frozenset({Role.PHYSICIST, Role.ADMIN})
"""Whoever tries Tidegate sees all of it: sessions, calibration, people and keys. At a site these are two persons."""


def put_person(data: Path, name: str, *, by: str) -> str:
    """Make the person, or give them a new password; return it: it is to be changed at the first log-in."""
    data.mkdir(mode=0o700, parents=True, exist_ok=True)  # it will hold password hashes
    with alone_in(data):
        database = Database(data / "tidegate.db")
        try:
            prepare(database, data_dir=data, min_free_disk_mb=0.0)
            return _one_time_password(database, name, by=by)
        finally:
            database.close()


def _one_time_password(database: Database, name: str, *, by: str) -> str:
    store = AccessStore(database)
    store.load()
    people = PeopleDesk(store, Argon2Hashing().hash)
    if name_key(name) in store.users:
        change = Change(roles=ROLES, is_disabled=False, reset_password=True)
        issued = people.change(name, change, by=by)
    else:
        issued = people.add(name, ROLES, by=by)
    return issued.one_time_password or ""
