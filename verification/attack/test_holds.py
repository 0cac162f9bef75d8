"""A hold is done on its head alone, whatever becomes of its body and of its sender; its connection ends cleanly."""

import pytest

from tests.support.service.api_calls import audit_rows
from tests.support.waiting import eventually
from verification.attack.limits import PATIENCE_S
from verification.attack.raw_connections import connection, read_all

LATEST_S = 3 * PATIENCE_S
BODY = b'{"a":"bc"}'
LATE = f"Content-Length: {len(BODY)}\r\n"
HEALTH = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
HEADS = {
    "never comes": LATE,
    "is of chunks that never come": "Transfer-Encoding: chunked\r\n",
    "waits to be asked for": LATE + "Expect: 100-continue\r\n",
    "says it is too large": "Content-Length: 99999999\r\n",
    "is packed": LATE + "Content-Encoding: gzip\r\n",
}


def head(attacked, more: str, who: str = "machine") -> bytes:
    sent = attacked.client.get("/healthz").request.headers
    mine = attacked.key if who == "machine" else {name: sent[name] for name in ("cookie", "origin")}
    lines = "".join(f"{name}: {value}\r\n" for name, value in mine.items())
    path = f"/api/v1/sessions/{attacked.session_id}/hold"
    return f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{attacked.port}\r\n{lines}{more}\r\n".encode()


def holds(attacked) -> int:
    return sum(row["outcome"] == "done" for row in audit_rows(attacked.client, "session.hold"))


def answer(raw) -> bytes:
    """Read the head of an answer and what comes with it; fails where none comes."""
    content = b""
    while b"\r\n\r\n" not in content or content.startswith(b"HTTP/1.1 100"):
        content = content.removeprefix(b"HTTP/1.1 100 Continue\r\n\r\n") + raw.recv(65536)
    said = int(content.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])
    while len(content.partition(b"\r\n\r\n")[2]) < said:
        content += raw.recv(65536)
    return content


@pytest.mark.parametrize("who", ["machine", "person"])
@pytest.mark.parametrize("name", HEADS)
def test_it_is_answered_though_its_body_does_not_come_and_then_its_connection_ends(attacked, name, who):
    before = holds(attacked)
    with connection(attacked.port) as raw:
        raw.sendall(head(attacked, HEADS[name], who))
        assert b"200 OK" in answer(raw)
        rest = read_all(raw, LATEST_S)
    assert holds(attacked) == before + 1
    assert (rest.content, rest.is_closed) == (b"", True), rest


@pytest.mark.parametrize("who", ["machine", "person"])
def test_it_is_done_though_its_sender_has_gone(attacked, who):
    before = holds(attacked)
    with connection(attacked.port) as raw:
        raw.sendall(head(attacked, LATE, who))
    eventually(lambda: holds(attacked) == before + 1)


def test_a_body_that_comes_after_the_answer_is_no_request_and_the_next_one_is_answered(attacked):
    with connection(attacked.port) as raw:
        for late in (BODY, HEALTH[:10]):
            raw.sendall(head(attacked, LATE))
            assert b"200 OK" in answer(raw)
            raw.sendall(late)
        raw.sendall(HEALTH)
        assert b'"ok"' in answer(raw)


def test_after_a_body_that_came_late_nothing_is_stated_that_was_not_asked_for(attacked):
    with connection(attacked.port) as raw:
        raw.sendall(head(attacked, LATE))
        assert b"200 OK" in answer(raw)
        raw.sendall(BODY)
        rest = read_all(raw, LATEST_S)
    assert (rest.content, rest.is_closed) == (b"", True), rest
