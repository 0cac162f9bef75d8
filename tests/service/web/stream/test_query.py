"""What is asked for is understood or refused before anything is sent; what is understood is said in the hello."""

import json
from types import MappingProxyType

import anyio
import httpx2
import pytest
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import QueryParams
from websockets.exceptions import InvalidStatus

from service.web.stream.websocket import _refuse, read_query
from tests.support.stream.stream_server import Served, messages, next_of
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

REFUSED = [
    ("rate_hz=0.1", "rate_hz"),
    ("rate_hz=61", "rate_hz"),
    ("rate_hz=nan", "rate_hz"),
    ("rate_hz=fast", "rate_hz"),
    ("rate_hz=1&rate_hz=2", "rate_hz"),
    ("form=thick", "form"),
    ("session_id=../../x&after_frame=1", "session_id"),
    (f"session_id={'0' * 32}&after_frame=-2", "after_frame"),
    (f"session_id={'0' * 32}&after_frame={2**60}", "after_frame"),
    ("token=abc", "token"),
]


@pytest.mark.parametrize(("query", "field"), [*REFUSED, ("encoding=xml", "encoding")])
def test_a_socket_that_asks_for_what_there_is_not_is_refused_with_a_problem_and_never_opened(
    service: Served, query: str, field: str
):
    with pytest.raises(InvalidStatus) as refused, service.watch(f"?{query}"):
        pass
    response = refused.value.response
    problem = json.loads(response.body)
    assert (response.status_code, problem["code"], problem["field"]) == (422, "invalid_value", field)
    assert problem["bound"]


@pytest.mark.parametrize(("query", "field"), [*REFUSED, ("encoding=json", "encoding")])
def test_an_event_stream_refuses_the_same(service: Served, query: str, field: str):
    with service.http() as client:
        answer = client.get(f"/api/v1/live/events?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_value")
    assert answer.json()["field"] == field


def test_where_the_server_cannot_answer_with_a_problem_the_close_names_it(service: Served):
    sent = []

    class Plain:
        scope = MappingProxyType({"extensions": {}})

        async def close(self, code, reason):
            sent.append((code, reason))

    async def refuse():
        try:
            read_query(QueryParams("rate_hz=1000"))
        except RequestValidationError as error:
            await _refuse(Plain(), error)

    anyio.run(refuse)
    assert sent == [(1008, "invalid_value: rate_hz: less than or equal to 60")]


def test_the_hello_states_how_the_stream_was_understood(service: Served, session_id: str):
    with service.watch():
        service.frames(1)
        with service.watch("?rate_hz=5&form=thin") as socket:
            hello = json.loads(socket.recv(timeout=PATIENCE_S))
            sample = json.loads(socket.recv(timeout=PATIENCE_S))
    assert hello["type"] == "hello"
    answered = {name: hello[name] for name in ("schema", "form", "rate_hz", "session_id", "camera_fps")}
    assert answered == {
        "schema": "tidegate.live/1",
        "form": "thin",
        "rate_hz": 5.0,
        "session_id": session_id,
        "camera_fps": 29.97,
    }
    assert (sample["type"], sample["form"], sample["frame_index"]) == ("sample", "thin", 0)


def test_an_asked_rate_is_kept_on_a_real_socket(service: Served, session_id: str):
    with service.watch("?rate_hz=0.2") as socket:
        next_of(socket, "hello")
        service.frames(1)
        first = next_of(socket, "sample")
        service.frames(10)
        service.running.operator_hold = "B. Nurse"
        service.frames(1)
        assert next(messages(socket))["type"] == "ping", "the next is due in five seconds"
    assert first["frame_index"] == 0


def test_no_one_watches_without_being_let_in(service: Served):
    assert httpx2.get(f"http://127.0.0.1:{service.port}/api/v1/live/events").status_code == 401
