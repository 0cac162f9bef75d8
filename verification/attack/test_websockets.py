"""Sockets whose frames do not keep to RFC 6455, or to any measure: closed with the code that says so."""

import pytest

from verification.attack.limits import SECRET
from verification.attack.raw_connections import ask, ask_socket, connection, frame, read_all, upgrade

PROTOCOL, NOT_UTF8, POLICY, TOO_BIG = 1002, 1007, 1008, 1009
TEXT, BINARY, PING, FIN = 1, 2, 9, 0x80
WORD = SECRET.encode()
FRAMES = {
    "a frame without a mask": (frame(FIN | TEXT, WORD, is_masked=False), PROTOCOL),
    "a ping in pieces": (frame(PING, WORD), PROTOCOL),
    "a ping that is too long": (frame(FIN | PING, WORD * 20), PROTOCOL),
    "a packed frame that nobody agreed on": (frame(FIN | 0x40 | TEXT, WORD), PROTOCOL),
    "a frame of an unknown kind": (frame(FIN | 3, WORD), PROTOCOL),
    "a piece of nothing": (frame(FIN, WORD), PROTOCOL),
    "a message begun twice": (frame(TEXT, WORD) + frame(FIN | TEXT, WORD), PROTOCOL),
    "a close of one byte": (frame(FIN | 8, b"x"), PROTOCOL),
    "text that is none": (frame(FIN | TEXT, b"\xff\xfe"), NOT_UTF8),
    "half a letter": (frame(TEXT, b"\xe2\x82") + frame(FIN, b"x"), NOT_UTF8),
    "a message that is too large": (frame(FIN | BINARY, WORD * 1000), TOO_BIG),
    "a message that says it is huge": (frame(FIN | BINARY, WORD, length=2**62), TOO_BIG),
    "pieces that are too large together": (frame(BINARY, WORD * 100) + frame(0, WORD * 100) * 4, TOO_BIG),
    "ten thousand tiny messages": (frame(FIN | TEXT, b"a") * 10_000, POLICY),
    "ten thousand empty pieces": (frame(TEXT, b"") + frame(0, b"") * 10_000 + frame(FIN | TEXT, b""), PROTOCOL),
}


@pytest.mark.parametrize("name", FRAMES)
def test_a_socket_that_does_not_keep_to_the_protocol_is_closed_with_the_reason(attacked, name):
    content, code = FRAMES[name]
    reply = ask_socket(attacked.port, upgrade(attacked.key), content)
    assert reply.status == 101
    assert reply.is_closed
    assert reply.close_code == code
    assert reply.seconds < 2.0


def test_compression_of_messages_is_not_negotiated(attacked):
    with connection(attacked.port) as raw:
        raw.sendall(upgrade(attacked.key, "Sec-WebSocket-Extensions: permessage-deflate; client_max_window_bits"))
        reply = read_all(raw, 0.3)
    assert reply.status == 101
    assert b"permessage" not in reply.content.lower()


@pytest.mark.parametrize(
    ("old", "new", "status"),
    [
        ("Sec-WebSocket-Version: 13", "Sec-WebSocket-Version: 7", 426),
        ("Sec-WebSocket-Key: ", "X-Key: ", 400),
        ("GET ", "POST ", 405),
        ("/api/v1/live", "/api/v1/nowhere", 403),
        ("Authorization: ", "X-Authorization: ", 403),
    ],
)
def test_a_handshake_that_is_none_is_refused(attacked, old, new, status):
    reply = ask(attacked.port, upgrade(attacked.key).replace(old.encode(), new.encode(), 1), within_s=3.0)
    assert reply.status is not None
    assert reply.status in {status, 400}
    assert reply.is_closed


def test_pings_to_somebody_who_takes_no_answers_fill_nothing(attacked):
    with connection(attacked.port, room=4096) as raw:
        raw.sendall(upgrade(attacked.key))
        raw.settimeout(3.0)
        try:
            for _ in range(200):
                raw.sendall(frame(FIN | PING, b"x" * 125) * 500)
        except (ConnectionError, TimeoutError):
            return
    pytest.fail("13 MB of pings were taken from a client that reads nothing")
