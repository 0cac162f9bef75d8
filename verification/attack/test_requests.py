"""Requests that do not keep to HTTP: refused with a problem where HTTP allows an answer, and their connection ends."""

import pytest

from verification.attack.limits import SECRET
from verification.attack.raw_connections import ask

HOST = b"Host: 127.0.0.1\r\n"
POST = b"POST /api/v1/auth/login HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\n"
GET = b"GET /healthz HTTP/1.1\r\n"
BODY = b'{"a":1}'
LONG = SECRET.encode() * 10_000
REFUSED = {
    "two lengths that differ": (POST + b"Content-Length: 7\r\nContent-Length: 8\r\n\r\n" + BODY, 400),
    "a length in a list": (POST + b"Content-Length: 7, 8\r\n\r\n" + BODY, 400),
    "a length below nothing": (POST + b"Content-Length: -1\r\n\r\n", 400),
    "a length with a sign": (POST + b"Content-Length: +7\r\n\r\n" + BODY, 400),
    "a length that is no number": (POST + b"Content-Length: 0x7\r\n\r\n" + BODY, 400),
    "chunks beside a length": (POST + b"Transfer-Encoding: chunked\r\nContent-Length: 7\r\n\r\n0\r\n\r\n", 400),
    "a length beside chunks": (POST + b"Content-Length: 7\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 400),
    "chunks twice": (POST + b"Transfer-Encoding: chunked, chunked\r\n\r\n0\r\n\r\n", 501),
    "chunks in two headers": (
        POST + b"Transfer-Encoding: chunked\r\nTransfer-Encoding: identity\r\n\r\n0\r\n\r\n",
        501,
    ),
    "chunks by another name": (POST + b"Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n", 501),
    "a packed transfer": (POST + b"Transfer-Encoding: gzip, chunked\r\n\r\n0\r\n\r\n", 501),
    "chunks in HTTP/1.0": (
        POST.replace(b"1.1\r\n", b"1.0\r\n", 1) + b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        400,
    ),
    "two hosts": (GET + HOST + HOST + b"\r\n", 400),
    "no host": (GET + b"\r\n", 400),
    "a folded header": (GET + HOST + b"X-A: a\r\n b\r\n\r\n", 400),
    "a header folded with a tab": (GET + HOST + b"X-A: a\r\n\tb\r\n\r\n", 400),
    "bare line feeds": (GET.replace(b"\r\n", b"\n") + HOST.replace(b"\r\n", b"\n") + b"\n", 400),
    "one bare line feed": (GET + HOST + b"X-A: a\nX-B: b\r\n\r\n", 400),
    "a lone carriage return": (GET + HOST + b"X-A: a\rb\r\n\r\n", 400),
    "NUL in a header": (GET + HOST + b"X-A: a\0b\r\n\r\n", 400),
    "NUL in the path": (b"GET /health\0z HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "a blank in front of the colon": (GET + HOST + b"Content-Length : 7\r\n\r\n", 400),
    "a header without a name": (GET + HOST + b": a\r\n\r\n", 400),
    "a whole URI": (b"GET http://evil.example/healthz HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "a proxy's CONNECT": (b"CONNECT evil.example:443 HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "no path": (b"OPTIONS * HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "HTTP/0.9": (b"GET /healthz\r\n\r\n", 400),
    "HTTP/2 out of nowhere": (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 400),
    "HTTP/3": (b"GET / HTTP/3\r\n" + HOST + b"\r\n", 400),
    "TLS where none is spoken": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(64), 400),
    "nothing but noise": (bytes(range(256)) * 8, 400),
    "a method of a hundred letters": (b"G" * 100 + b" / HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "a URL that is too long": (b"GET /" + LONG[:5_000] + b" HTTP/1.1\r\n" + HOST + b"\r\n", 414),
    "a URL without end": (b"GET /" + LONG, 414),
    "a header that is too long": (GET + HOST + b"X-A: " + LONG[:20_000] + b"\r\n\r\n", 431),
    "a header without end": (GET + HOST + b"X-A: " + LONG, 431),
    "too many headers": (GET + HOST + b"".join(b"X-%d: a\r\n" % i for i in range(100)) + b"\r\n", 431),
}
CODES = {400: "bad_request", 414: "url_too_long", 431: "headers_too_large", 501: "not_implemented"}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_request_is_refused_with_a_problem_and_ends_its_connection(attacked, name):
    content, status = REFUSED[name]
    reply = ask(attacked.port, content)
    assert (reply.status, reply.is_closed) == (status, True), reply
    assert reply.statuses == [status]  # nothing behind it is taken for a further request
    assert reply.problem["code"] == CODES[status]
    assert b"content-security-policy" in reply.content.lower()
    assert reply.seconds < 0.5


def _keyed(attacked, path: str, more: bytes) -> bytes:
    key = "".join(f"{name}: {value}\r\n" for name, value in attacked.key.items()).encode()
    return b"POST " + path.encode() + b" HTTP/1.1\r\n" + HOST + key + b"Content-Type: application/json\r\n" + more


CHUNKED = b"Transfer-Encoding: chunked\r\n\r\n"
BODIES = {
    "a chunk's size that is no number": (CHUNKED + b"xyz\r\n", 400, "bad_request"),
    "a chunk's size below nothing": (CHUNKED + b"-5\r\nhello\r\n", 400, "bad_request"),
    "a chunk's size of 64 digits": (CHUNKED + b"f" * 64 + b"\r\n", 400, "bad_request"),
    "a chunk longer than it says": (CHUNKED + b'2\r\n{"a":1}\r\n0\r\n\r\n', 400, "bad_request"),
    "a chunk's extension without end": (CHUNKED + b"1;" + LONG, 431, "headers_too_large"),
    "trailers without end": (CHUNKED + b"0\r\nX-A: " + LONG, 431, "headers_too_large"),
    "a packed body": (b"Content-Encoding: gzip\r\nContent-Length: 7\r\n\r\n" + BODY, 415, "media_type"),
    "a deflated body": (b"Content-Encoding: deflate, identity\r\nContent-Length: 7\r\n\r\n" + BODY, 415, "media_type"),
    "a body that says it is large": (b"Content-Length: 99999999\r\n\r\n", 413, "body_too_large"),
    "a body that is larger than a body is": (
        CHUNKED + (b"4000\r\n" + LONG[:16384] + b"\r\n") * 6,
        413,
        "body_too_large",
    ),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_body_that_is_none_is_refused(attacked, name):
    more, status, code = BODIES[name]
    path = f"/api/v1/sessions/{attacked.session_id}/arm"
    reply = ask(attacked.port, _keyed(attacked, path, more), within_s=3.0)
    assert (reply.statuses, reply.problem["code"]) == ([status], code), reply
    assert reply.is_closed


def test_a_body_of_chunks_that_are_all_extension_is_cut_off(attacked):
    chunk = b"1;" + b"x" * 8_000 + b"\r\na\r\n"
    path = f"/api/v1/sessions/{attacked.session_id}/arm"
    reply = ask(attacked.port, _keyed(attacked, path, CHUNKED + chunk * 2_000))
    assert reply.is_closed
    assert reply.status in {400, None}  # none, where the answer met what was still on its way


def test_an_upgrade_that_is_not_spoken_here_is_an_ordinary_request(attacked):
    more = b"Connection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\nHTTP2-Settings: AAMAAABkAARAAAAAAAIAAAAA\r\n\r\n"
    assert ask(attacked.port, GET + HOST + more).statuses == [200]


def test_requests_sent_at_once_are_answered_in_turn_and_the_bad_one_ends_it(attacked):
    good = GET + HOST + b"\r\n"
    reply = ask(attacked.port, good * 20 + GET + HOST + HOST + b"\r\n" + good)
    assert reply.statuses == [200] * 20 + [400]
    assert reply.is_closed


def test_a_flood_of_bad_requests_leaves_a_line_now_and_then_and_not_one_each(attacked):
    before = attacked.log.read_text(errors="replace").count("connections refused")
    for _ in range(200):
        assert ask(attacked.port, GET + b"\r\n").status == 400
    assert attacked.log.read_text(errors="replace").count("connections refused") - before <= 2
