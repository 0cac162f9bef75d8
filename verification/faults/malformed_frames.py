"""Frames whose heads lie: sizes, shapes, formats, numbers and times; each sort is a kind of its own."""

import random
from collections.abc import Callable

from tests.support.virtual_camera.block import Field, Streams
from tests.support.virtual_camera.camera import Receipt, VirtualXtion
from verification.faults.frame_faults import CLOCK, GONE, GONE_RECOVERS, SILENT, UNREAD, Act, of_camera
from verification.faults.kinds import BY_ITSELF, LATCHED, FaultKind, reported

FAMILY = "malformed"
RGB888, GRAY8 = 200, 202
REFUSED = SILENT | CLOCK | UNREAD | reported("value_invalid", "source_lost", "engine_failed")


def _field(field: Field, value: Callable[[random.Random], int], streams: Streams) -> Act:
    def act(camera: VirtualXtion, chance: random.Random) -> Receipt:
        return camera.malform(field, value(chance), streams)

    return act


def _numbers_back(camera: VirtualXtion, chance: random.Random) -> Receipt:
    """Let numbers go back, but not below zero: those are refused as no numbers at all."""
    return camera.index(-chance.randrange(2, max(min(camera.status.index[0], 500), 3)))


def _kind(code: str, what: str, act: Act, *, is_step: bool = False, must_latch: bool = False) -> FaultKind:
    return FaultKind(
        code=f"malformed-{code}",
        what=what,
        family=FAMILY,
        inject=of_camera(act, is_step=is_step),
        reported=REFUSED | GONE,
        recoveries=LATCHED if must_latch else BY_ITSELF | GONE_RECOVERS,
    )


DEPTH = Streams.DEPTH
KINDS = (
    _kind(
        "size",
        "less data than a picture has",
        _field(Field.DATA_SIZE, lambda chance: chance.randrange(0, 600_000), DEPTH),
    ),
    _kind(
        "width",
        "a wrong width",
        _field(Field.WIDTH, lambda chance: chance.choice((0, 1, 320, 639, 641, 100_000)), DEPTH),
    ),
    _kind(
        "height",
        "a wrong height",
        _field(Field.HEIGHT, lambda chance: chance.choice((0, 1, 240, 479, 481, 100_000)), DEPTH),
    ),
    _kind(
        "stride",
        "a wrong stride",
        _field(Field.STRIDE, lambda chance: chance.choice((0, 640, 1279, 1282, -1280)), DEPTH),
    ),
    _kind(
        "format",
        "a wrong pixel format",
        _field(Field.FORMAT, lambda chance: chance.choice((0, 101, RGB888, GRAY8, 9999)), DEPTH),
    ),
    _kind(
        "index-back",
        "frame numbers go back",
        _numbers_back,
        is_step=True,
        must_latch=True,
    ),
    _kind(
        "index-jump",
        "frame numbers jump ahead",
        lambda camera, chance: camera.index(chance.randrange(2, 10_000)),
        is_step=True,
    ),
    _kind("time-zero", "times of 0", lambda camera, _: camera.timestamp(0), must_latch=True),
    _kind("time-huge", "times of 2^62 us", lambda camera, _: camera.timestamp(2**62)),
    _kind("no-data", "frames without a picture", lambda camera, _: camera.malform(Field.NO_DATA, 0, DEPTH)),
)
