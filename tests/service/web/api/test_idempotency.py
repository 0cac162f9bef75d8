"""An Idempotency-Key belongs to its caller, is worked on once at a time, and is forgotten in its time."""

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import pytest
from pydantic import BaseModel
from sqlalchemy import func, select

from service.core.errors import IdempotencyInProgressError
from service.storage.database import idempotency
from service.storage.database.idempotency import CallersKey, InProgress, earlier_answer, forget_answers, keep_answer
from service.storage.database.tables import IdempotencyRow, SessionRow
from tests.support.service.api_calls import act, make_calibration, upload
from tests.support.waiting import PATIENCE_S

V1 = "/api/v1"
KEY = {"Idempotency-Key": "6b1f0d3c-1c54"}
NOW = datetime(2026, 11, 22, tzinfo=UTC)


class Answer(BaseModel):
    text: str


def kept(database, key, text="x"):
    with database.write() as db:
        keep_answer(db, "r", key, b"request", Answer(text=text))


def read_back(database, key):
    with database.read() as db:
        return earlier_answer(db, "r", key, b"request", Answer)


def of(caller, key="k"):
    return CallersKey(caller=caller, key=key)


@pytest.fixture
def settings(settings):
    return settings.model_copy(update={"allow_device_registration": True})


@pytest.fixture
def tables(database):
    database.migrate()
    return database


@pytest.mark.both_databases
def test_another_caller_s_key_is_another_key(client, session_body):
    first = client.post(f"{V1}/sessions", json=session_body, headers=KEY).json()
    act(client, first["id"], "stop")
    other = session_body | {"operator": "B. Physicist"}
    second = client.post(f"{V1}/sessions", json=other, headers=KEY)
    assert (second.status_code, second.headers.get("Idempotency-Replayed")) == (201, None)
    assert second.json()["id"] != first["id"]
    again = client.post(f"{V1}/sessions", json=session_body, headers=KEY)
    assert (again.json()["id"], again.headers["Idempotency-Replayed"]) == (first["id"], "true")


@pytest.mark.both_databases
def test_many_requests_at_once_with_one_key_make_one_session(client, session_body, engine):
    client.headers_as("A. Therapist")
    all_at_once = threading.Barrier(8)

    def create(_number):
        all_at_once.wait(PATIENCE_S)
        return client.post(f"{V1}/sessions", json=session_body, headers=KEY)

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(create, range(8)))
    made = {answer.json()["id"] for answer in answers if answer.status_code == 201}
    refused = {answer.json()["code"] for answer in answers if answer.status_code != 201}
    assert len(made) == 1
    assert refused <= {"idempotency_in_progress"}
    assert client.get(f"{V1}/sessions").json()["items"][0]["id"] in made
    assert len(client.get(f"{V1}/sessions").json()["items"]) == 1


def test_a_key_that_is_worked_on_is_refused_and_states_when_to_come_again(client, session_body, engine):
    """The camera is asked in the middle of a creation: a second request comes right then."""
    beside = []
    body = {**session_body, "source": {"kind": "device"}, "calibration_id": None}
    engine.while_probed = lambda: beside.append(client.post(f"{V1}/sessions", json=body, headers=KEY))
    assert client.post(f"{V1}/sessions", json=body, headers=KEY).status_code == 201
    assert (beside[0].status_code, beside[0].json()["code"]) == (409, "idempotency_in_progress")
    assert beside[0].headers["Retry-After"] == "1"
    assert client.post(f"{V1}/sessions", json=body, headers=KEY).headers["Idempotency-Replayed"] == "true"


def test_only_the_same_key_of_the_same_caller_is_in_the_way():
    busy = InProgress()
    with busy.only(of("a")):
        with busy.only(of("b")), busy.only(of("a", "other")), busy.only(None), busy.only(None):
            pass
        with pytest.raises(IdempotencyInProgressError), busy.only(of("a")):
            pass
    with busy.only(of("a")):
        pass


def test_a_key_is_free_again_when_what_it_was_for_failed():
    busy = InProgress()
    with pytest.raises(ZeroDivisionError), busy.only(of("a")):
        raise ZeroDivisionError
    with busy.only(of("a")):
        pass


@pytest.mark.both_databases
def test_what_is_older_than_the_site_keeps_it_is_forgotten(tables):
    kept(tables, of("a"))
    assert forget_answers(tables, days=7.0, now=datetime.now(UTC) + timedelta(days=6.9)) == 0
    assert read_back(tables, of("a")) == Answer(text="x")
    assert forget_answers(tables, days=7.0, now=datetime.now(UTC) + timedelta(days=7.1)) == 1
    assert read_back(tables, of("a")) is None


@pytest.mark.both_databases
def test_too_many_keys_evict_only_the_oldest_of_the_same_caller(tables, monkeypatch):
    monkeypatch.setattr(idempotency, "MAX_KEYS", 5)
    kept(tables, of("b"))
    for number in range(8):
        kept(tables, of("a", str(number)), text=str(number))
    assert [read_back(tables, of("a", str(number))) is None for number in range(8)] == [True] * 3 + [False] * 5
    assert read_back(tables, of("b")) is not None
    with tables.read() as db:
        assert db.scalar(select(func.count()).select_from(IdempotencyRow)) == 6


def test_a_key_is_stored_so_that_no_one_reads_it_back(client, session_body):
    client.post(f"{V1}/sessions", json=session_body, headers=KEY)
    with client.app.state.services.sessions._database.read() as db:
        row = db.scalars(select(IdempotencyRow)).one()
        assert KEY["Idempotency-Key"] not in row.key
        assert len(row.key) == 97
        assert db.scalar(select(func.count()).select_from(SessionRow)) == 1


def test_an_upload_s_key_is_its_caller_s_too(client):
    text = make_calibration("one").to_json()
    first = upload(client, text, **KEY)
    other = upload(client, make_calibration("two").to_json(), **KEY)
    assert (first.status_code, other.status_code, other.json()["code"]) == (201, 409, "idempotency_key_reused")
