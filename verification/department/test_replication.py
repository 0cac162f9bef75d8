"""Records of a room arrive at the hub by PostgreSQL's logical replication: before, while and after it was away."""

from contextlib import closing

import pytest
from sqlalchemy import inspect, text
from sqlalchemy.exc import DBAPIError

from service.monitoring.metrics.machine import read_slots
from service.storage.audit.check import check_chain
from service.storage.database.base import Base
from service.storage.database.engine import Database
from tests.support.audit.rows import fill
from tests.support.database.postgres import PostgresServer
from tests.support.database.rows import add_rows
from tests.support.database.second_revision import FIRST
from tests.support.department.replication import (
    PASSWORD,
    ROLE,
    ROOM_SETTINGS,
    FollowedRoom,
    ScriptError,
    answer,
    complete,
    end_subscription,
    execute,
    hub_database,
    publish,
    run_file,
    subscribe,
)
from tests.support.waiting import eventually

SECRETS = {"users", "logins", "api_keys", "failed_logins", "idempotency_keys"}
"""What stays in the room. A new table is either published or listed here."""


def add_one_of_each(room):
    with room.database.write() as db:
        add_rows(db.connection(), but=("audit",))


def verified_at_hub(room):
    with closing(room.at_hub()) as database:
        return check_chain(database)


def test_rows_of_before_and_after_arrive_and_the_audit_is_intact_there(followed):
    fill(followed.database, 30)
    add_one_of_each(followed)  # with a QA run that has ended, whose results come in any order
    followed.follow()
    fill(followed.database, 5)
    add_one_of_each(followed)
    with followed.database.write() as db:
        db.execute(text("UPDATE sessions SET status = 'ended', summary = '{}'"))
    count = followed.arrive()
    assert count.startswith("audit|35|")
    assert [line.split("|")[1] for line in count.splitlines()[1:11]] == ["2"] * 10
    assert answer(followed.hub, followed.hub_name, "SELECT min(status) FROM sessions") == "ended"
    found = verified_at_hub(followed)
    assert (found.is_intact, found.rows) == (True, 35)


def test_rows_of_before_arrive_in_whatever_order_they_lie_on_the_room_s_disk(followed):
    fill(followed.database, 30)
    # Rows that were rolled back leave room that later ones fill; an index is the quickest way to another order.
    execute(followed.room, followed.name, "CREATE INDEX by_hash ON audit (hash)", "CLUSTER audit USING by_hash")
    followed.follow()
    fill(followed.database, 1)
    assert followed.arrive().startswith("audit|31|")
    assert verified_at_hub(followed).is_intact


@pytest.mark.parametrize("end", ["kill", "stop"])
def test_a_hub_that_was_away_gets_everything_afterwards_and_the_room_never_waits(followed, end):
    fill(followed.database, 3)
    followed.follow()
    followed.arrive()
    getattr(followed.hub, end)()
    try:
        eventually(lambda: followed.slot("active") is False)
        fill(followed.database, 200)
        add_one_of_each(followed)
    finally:
        followed.hub.start()
    assert followed.arrive().startswith("audit|203|")
    assert verified_at_hub(followed).is_intact


def test_a_room_that_was_killed_is_followed_again(followed):
    fill(followed.database, 3)
    followed.follow()
    followed.room.kill()
    followed.room.start()
    followed.database.close()
    followed.database = Database(followed.url)
    fill(followed.database, 3)
    assert followed.arrive().startswith("audit|6|")


def test_accounts_and_keys_stay_in_the_room(followed):
    add_one_of_each(followed)
    followed.follow()
    add_one_of_each(followed)
    followed.arrive()
    with closing(Database(followed.room.tcp_url(followed.name).set(username=ROLE, password=PASSWORD))) as database:
        for table in SECRETS:
            assert answer(followed.hub, followed.hub_name, f"SELECT count(*) FROM {table}") == 0
            with pytest.raises(DBAPIError, match="permission denied"), database.connect() as connection:
                connection.execute(text(f"SELECT * FROM {table}"))


def test_every_table_is_either_published_or_a_secret_and_has_a_key_to_follow_its_changes_by(followed):
    followed.follow()
    query = text("SELECT tablename FROM pg_publication_tables WHERE pubname = 'tidegate_records'")
    with followed.database.connect() as connection:
        published = set(connection.scalars(query))
        assert published == set(Base.metadata.tables) - SECRETS
        for table in published:
            assert inspect(connection).get_pk_constraint(table)["constrained_columns"], table
        counted = {line.split("|")[0] for line in followed.counts()[0].splitlines() if line}
    assert counted == published


def test_every_trigger_works_for_the_worker_that_applies_rows(followed):
    late = "SELECT count(*) FROM pg_trigger WHERE NOT tgisinternal AND tgenabled <> 'A'"
    loose = (
        "SELECT count(*) FROM pg_proc WHERE pronamespace = 'public'::regnamespace "
        "AND proconfig IS DISTINCT FROM '{\"search_path=public, pg_temp\"}'"
    )
    followed.follow()
    for server, name in ((followed.room, followed.name), (followed.hub, followed.hub_name)):
        assert answer(server, name, late) == 0
        assert answer(server, name, loose) == 0


def test_a_table_of_the_caller_s_own_is_not_taken_for_the_audit(followed):
    fill(followed.database, 2)
    decoy = "CREATE TEMP TABLE audit AS SELECT 98::bigint AS sequence"
    columns = "at, actor, action, outcome, session_id, detail, hash, hash"
    forged = f"INSERT INTO public.audit SELECT 99, {columns} FROM public.audit LIMIT 1"
    with followed.database.connect() as connection:
        connection.execute(text(decoy))
        with pytest.raises(DBAPIError, match="next row only"):
            connection.execute(text(forged))


@pytest.mark.usefixtures("second")
@pytest.mark.parametrize(("room_revision", "hub_revision"), [("head", FIRST), (FIRST, "head")])
def test_a_hub_of_the_older_version_waits_and_one_of_the_newer_takes_everything(
    room_server, hub_server, room_revision, hub_revision
):
    room = FollowedRoom(room_server, hub_server, hub_revision=hub_revision)
    try:
        room.database.migrate(room_revision)
        publish(room.room, room.name)
        subscribe(room.hub, room.hub_name, room.room, room.name)
        add_one_of_each(room)
        if hub_revision != "head":
            with pytest.raises(ScriptError, match="not all copied yet"):
                run_file(room.hub, room.hub_name, "hub-complete.sql")
            assert answer(room.hub, room.hub_name, "SELECT count(*) FROM sessions") == 0
            with closing(room.at_hub()) as database:
                database.migrate()
        complete(room.hub, room.hub_name)
        fill(room.database, 2)
        assert room.arrive().startswith("audit|2|")
    finally:
        execute(room.hub, room.hub_name, f"DROP SUBSCRIPTION {room.hub_name}")
        room.close()


@pytest.fixture
def narrow_room(hub_server):
    """A room that keeps 1 MB for a hub that is away."""
    server = PostgresServer(ROOM_SETTINGS | {"max_slot_wal_keep_size": "1MB"})
    room = FollowedRoom(server, hub_server)
    yield room
    room.database.close()
    server.close()
    end_subscription(hub_server, room.hub_name)


def test_a_hub_away_beyond_the_bound_is_left_and_copies_everything_again(narrow_room):
    room = narrow_room
    fill(room.database, 3)
    room.follow()
    room.arrive()
    execute(room.hub, room.hub_name, f"ALTER SUBSCRIPTION {room.hub_name} DISABLE")
    eventually(lambda: room.slot("active") is False)
    execute(room.room, room.name, *(["CREATE TABLE filler ()", "DROP TABLE filler", "SELECT pg_switch_wal()"] * 3))
    execute(room.room, room.name, "CHECKPOINT")
    assert room.slot("wal_status") == "lost"
    with room.database.read() as db:
        assert [slot.is_lost for slot in read_slots(db)] == [True]
    fill(room.database, 50)
    end_subscription(room.hub, room.hub_name)
    room.hub_name = hub_database(room.hub)
    subscribe(room.hub, room.hub_name, room.room, room.name)
    complete(room.hub, room.hub_name)
    assert room.arrive().startswith("audit|53|")
    assert verified_at_hub(room).is_intact


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("wal_level", "replica", "needs logical"), ("max_slot_wal_keep_size", "-1", "has no bound")],
)
def test_a_room_that_cannot_or_must_not_be_followed_is_refused(name, value, said):
    server = PostgresServer({"wal_level": "logical", "max_slot_wal_keep_size": "64MB", name: value})
    try:
        with pytest.raises(ScriptError, match=said):
            run_file(server, str(server.migrated().database), "room.sql")
    finally:
        server.close()


def test_publishing_again_after_an_upgrade_changes_nothing(followed):
    followed.follow()
    publish(followed.room, followed.name)
    fill(followed.database, 2)
    assert followed.arrive().startswith("audit|2|")
