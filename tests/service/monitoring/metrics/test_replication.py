"""The slots of a department are metrics of the room: followed, away, lost, and without a bound."""

import pytest
from sqlalchemy import text

from service.monitoring.metrics.machine import DatabaseFigures, ReplicationSlot, slot_metrics
from service.storage.database.engine import Database
from tests.support.audit.rows import fill
from tests.support.database.postgres import PostgresServer
from tests.support.department.replication import execute
from tests.support.waiting import eventually

MADE = "SELECT pg_create_logical_replication_slot('{}', 'pgoutput')"


def values(slots):
    return {sample.name: sample.value for family in slot_metrics(slots) for sample in family.samples}


def slots_of(database):
    figures = DatabaseFigures(database).read()
    assert figures is not None
    return figures.slots


def test_a_hub_that_follows_is_active_and_one_that_left_is_behind(followed):
    fill(followed.database, 2)
    followed.follow()
    followed.arrive()
    (slot,) = slots_of(followed.database)
    assert (slot.name, slot.is_active, slot.is_lost) == (followed.hub_name, True, False)
    assert slot.limit_bytes == 64 * 1024 * 1024
    followed.hub.stop()
    try:
        eventually(lambda: not slots_of(followed.database)[0].is_active)
        before = slots_of(followed.database)[0].behind_bytes
        fill(followed.database, 100)
        assert slots_of(followed.database)[0].behind_bytes > before + 100 * 300
    finally:
        followed.hub.start()
    followed.arrive()
    eventually(lambda: slots_of(followed.database)[0].is_active)


def test_slots_of_other_databases_and_of_copies_of_the_server_are_not_this_room_s(followed):
    with followed.database.connect() as connection:
        connection.execute(text("SELECT pg_create_physical_replication_slot('copy')"))
        connection.commit()
        execute(followed.room, "postgres", MADE.format("elsewhere"))
        try:
            assert slots_of(followed.database) == ()
        finally:
            connection.execute(text("SELECT pg_drop_replication_slot('copy')"))
            connection.commit()
            execute(followed.room, "postgres", "SELECT pg_drop_replication_slot('elsewhere')")


@pytest.fixture
def careless_server():
    server = PostgresServer({"wal_level": "logical", "max_slot_wal_keep_size": "-1"})
    yield server
    server.close()


def test_a_slot_without_a_bound_is_a_negative_limit(careless_server):
    database = Database(careless_server.migrated())
    with database.connect() as connection:
        connection.execute(text(MADE.format("hub")))
        connection.commit()
    (slot,) = slots_of(database)
    database.close()
    assert (slot.limit_bytes, slot.is_active) == (-1, False)


def test_a_lost_slot_is_stated_and_what_is_not_known_is_left_out():
    slot = ReplicationSlot(name="room_1", is_active=False, is_lost=True, behind_bytes=None, limit_bytes=2**32)
    assert values([slot]) == {
        "tidegate_replication_active": 0.0,
        "tidegate_replication_lost": 1.0,
        "tidegate_replication_limit_bytes": 2.0**32,
    }
