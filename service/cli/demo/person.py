"""The account of the demonstration, created in its data folder before the service starts."""

from pathlib import Path

from service.access.accounts.names import name_key
from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.people import AccountService, Change
from service.access.accounts.store import AccessStore
from service.core.permissions import Role
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from service.storage.files.folder_lock import alone_in

ROLES = frozenset({Role.PHYSICIST, Role.ADMIN})
"""All roles, so that the demonstration shows every page. At a site two people have them."""


def put_person(data: Path, name: str, *, by: str) -> str:
    """Create the account or reset its password; return the one-time password."""
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
    people = AccountService(store, Argon2Hashing().hash)
    if name_key(name) in store.users:
        change = Change(roles=ROLES, is_disabled=False, reset_password=True)
        issued = people.change(name, change, by=by)
    else:
        issued = people.add(name, ROLES, by=by)
    return issued.one_time_password or ""
