"""The evidence that a live camera's frames are fresh is on the tape, so that a session is replayed with it."""

from dataclasses import replace

from engine.core.commands import Arm
from engine.offline.replay.inputs import FrameHead
from tests.support.control.loop_bench import DESCRIPTION, good
from tests.support.gating.streams import LIMITS
from tests.support.replay.scripted_tape import NO_MODELS, lived, replayed, taped

ARM = Arm(operator="ann", head_direction=LIMITS.head_direction)
HEAD = FrameHead(index=3, device_index=4, missed_frames=0, timestamp_us=5, color_timestamp_us=6, received_ns=70)


def unproven(source, timeout_s):
    return replace(good(source, timeout_s), queue_empty_ns=None)


def session(tmp_path, name, step):
    one = taped()
    one.source.open = lambda: replace(DESCRIPTION, is_live=True)

    def armed(source, timeout_s):
        one.loop.submit(ARM)
        return step(source, timeout_s)

    lived([*[step] * 3, armed, *[step] * 8], one)
    return bool(one.beam.permits), replayed(one.write(tmp_path / name))


def test_a_live_session_replays_with_the_evidence_that_it_had(tmp_path):
    was_on, tap = session(tmp_path, "fresh", good)
    assert (was_on, tap.difference, tap.frames) == (True, None, 12)
    was_on, tap = session(tmp_path, "unproven", unproven)
    assert (was_on, tap.difference, tap.frames) == (False, None, 12)


def test_a_frame_of_an_earlier_tape_has_no_evidence_and_counts_as_fresh():
    encoded = NO_MODELS.encode(HEAD)
    del encoded["d"][1]["queue_empty_ns"]
    decoded = NO_MODELS.decode(encoded)
    assert decoded == HEAD
    assert decoded.as_fresh() == replace(HEAD, queue_empty_ns=70)
