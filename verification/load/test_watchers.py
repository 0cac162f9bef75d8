"""What a light client counts of the bytes that it gets, however they are cut."""

import asyncio
import json
import struct

import pytest

from verification.load.watchers import Newest, Watcher

pytestmark = pytest.mark.waiting

ASKED = {"query": "", "port": 1, "authorization": "Bearer x"}
PONG_OF_HI = b"\x8a\x82\x00\x00\x00\x00hi"


class WrittenTo(asyncio.Transport):
    """A transport that keeps what is written."""

    def __init__(self) -> None:
        super().__init__()
        self.written = b""
        self.is_paused = False

    def write(self, data: bytes) -> None:
        self.written += data

    def pause_reading(self) -> None:
        self.is_paused = True


def sample(sequence: int, frame_index: int, *, length: int = 0) -> bytes:
    said = {"type": "sample", "sequence": sequence, "sent_at": "2026-11-21T03:00:00Z", "age_ms": 1.0}
    return json.dumps({**said, "frame_index": frame_index, "rest": "x" * length}).encode()


def sent(payload: bytes, opcode: int = 1) -> bytes:
    length = bytes([len(payload)]) if len(payload) < 126 else b"\x7e" + struct.pack(">H", len(payload))
    return bytes([0x80 | opcode]) + length + payload


def watched(*pieces: bytes, newest: Newest | None = None, is_events: bool = False, is_stalled: bool = False) -> Watcher:
    """Let a watcher hear some bytes, piece by piece, after a handshake."""

    async def watch_pieces() -> Watcher:
        watcher = Watcher(ASKED, newest or Newest(), is_events=is_events, is_stalled=is_stalled)
        watcher.connection_made(WrittenTo())
        watcher.data_received(b"HTTP/1.1 200 OK\r\n\r\n" if is_events else b"HTTP/1.1 101 Switching\r\n\r\n")
        for piece in pieces:
            watcher.data_received(piece)
        return watcher

    return asyncio.run(watch_pieces())


@pytest.mark.parametrize("size", [1, 7, 100, 10_000])
def test_messages_are_counted_however_they_are_cut(size):
    whole = b"".join(sent(sample(number, number, length=100 * number)) for number in range(4))
    seen = watched(*(whole[at : at + size] for at in range(0, len(whole), size))).seen
    assert (seen.samples, seen.gaps, seen.backwards) == (4, 0, 0)
    assert sum(seen.ages) == 4


def test_numbers_left_out_are_gaps_and_those_that_go_back_are_stated():
    seen = watched(*(sent(sample(number, number)) for number in (5, 6, 9, 8))).seen
    assert (seen.gaps, seen.lost_to_gaps, seen.backwards) == (1, 2, 1)


def test_messages_reported_as_skipped_are_counted():
    dropped = json.dumps({"type": "dropped", "skipped": 7}).encode()
    seen = watched(sent(dropped), sent(sample(9, 9))).seen
    assert (seen.skipped_reported, dict(seen.other), seen.samples) == (7, {"dropped": 1}, 1)


def test_a_client_is_behind_the_newest_frame_sent_to_any_other():
    newest = Newest()
    watched(sent(sample(0, 10)), newest=newest)
    seen = watched(sent(sample(0, 7)), sent(sample(1, 9)), newest=newest).seen
    assert (seen.worst_lag_frames, seen.behind_two) == (3, 1)


def test_a_ping_is_answered_and_a_close_is_reported():
    watcher = watched(sent(b"hi", opcode=9), sent(b"\x03\xf4too slow", opcode=8))
    assert watcher._transport.written.endswith(PONG_OF_HI)
    assert watcher.seen.closed == "closed with 1012 too slow"


def test_a_client_that_never_reads_stops_reading_after_the_handshake():
    assert watched(is_stalled=True)._transport.is_paused
    assert not watched()._transport.is_paused


def test_events_are_counted_too():
    event = b"event: sample\nid: 1\ndata: " + sample(3, 3) + b"\n\n"
    seen = watched(b"40\r\n" + event[:30], event[30:] + b"\r\n: ping\n\n", is_events=True).seen
    assert seen.samples == 1


def test_a_client_that_is_refused_states_with_what():
    async def watch_pieces() -> Watcher:
        watcher = Watcher(ASKED, Newest(), is_events=False, is_stalled=False)
        watcher.connection_made(WrittenTo())
        watcher.data_received(b"HTTP/1.1 403 Forbidden\r\n\r\n")
        return watcher

    assert asyncio.run(watch_pieces()).seen.closed == "refused with 403"
