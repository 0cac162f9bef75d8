"""The evidence that a live camera's frames are fresh is on the tape, so that a session is replayed with it."""

from dataclasses import replace

from engine.core.commands import Arm
from tests.support.control.loop_bench import DESCRIPTION, good
from tests.support.gating.streams import LIMITS
from tests.support.replay.scripted_tape import lived, replayed, taped

ARM = Arm(operator="ann", head_direction=LIMITS.head_direction)


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
