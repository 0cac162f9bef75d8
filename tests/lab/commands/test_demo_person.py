"""The demo's person: real, put there while no one serves the folder, with a password for one log-in."""

import pytest

from lab.commands.demo.command import put_person
from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.store import AccessStore
from service.core.permissions import Permission, permissions_of
from service.storage.database.engine import Database
from service.storage.files.folder_lock import FolderInUseError, alone_in


def people_in(folder):
    database = Database(folder / "tidegate.db")
    store = AccessStore(database)
    store.load()
    database.close()
    return store.users


def test_the_person_gets_a_new_password_for_every_demo_and_the_old_one_is_void(tmp_path):
    first, second = (put_person(tmp_path / "data", "Demo", by="a test") for _ in range(2))
    (person,) = people_in(tmp_path / "data").values()
    assert first != second
    assert not Argon2Hashing().verify(person.password_hash, first)
    assert Argon2Hashing().verify(person.password_hash, second)
    assert person.must_change_password
    assert {Permission.GATE_ARM, Permission.CALIBRATIONS_WRITE, Permission.USERS_MANAGE} <= permissions_of(person.roles)


def test_no_account_is_added_to_a_folder_that_a_service_uses(tmp_path):
    with alone_in(tmp_path), pytest.raises(FolderInUseError):
        put_person(tmp_path, "Demo", by="a test")
