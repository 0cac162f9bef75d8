"""What frames show, and how they come: covered, shifted, frozen, late, missing; the camera gone or hung."""

import math
import random
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from engine.core.clock import NS_PER_MS
from engine.motion.cross_check.cross_check import AVERAGED_US
from tests.support.virtual_camera.block import Call, State, Streams
from tests.support.virtual_camera.camera import Receipt, VirtualXtion
from verification.faults.kinds import (
    ARMED,
    BY_ITSELF,
    FRAME_MS,
    LAG_MS,
    LATCHED,
    NEW_SESSION,
    Fault,
    FaultKind,
    Inject,
    reported,
)
from verification.faults.plan import ANY_HEIGHT
from verification.faults.verdict import Recovery

if TYPE_CHECKING:
    from verification.faults.rig import Rig

FAMILY = "frames"
PERIOD_MS = 1000.0 / 29.97
BREATH_MM = 10.0
LASTS_S = (0.03, 0.8)
AVERAGED = {"bound": "averaged over 200 ms, then 100 ms", "bound_ms": AVERAGED_US / 1000 + FRAME_MS}
"""The bound of what the second estimate finds."""
BLANKETS_RGB = (0xF2F2EE, 0x4A6FA5, 0x8FBC8F)
"""White, blue and green hospital linen."""
Act = Callable[[VirtualXtion, random.Random], Receipt]
HIDDEN = reported("marker_lost", "layout_changed")
OBJECT = reported("residual_high", "surface_changed", "layout_changed")
"""Something on the patient; under a marker it moves that too."""
MOVED = reported("patient_shifted", "baseline_drifted", "layout_changed", "jump")
"""A body that moves; one that moves faster than the frames tears the markers' distances or the signal first."""
CAMERA = reported("camera_moved", "patient_shifted", "layout_changed", "jump")
UNREAD = reported("coverage_low", "residual_high")
FROZEN = reported("frame_frozen", "frame_stale")
SILENT = reported("frame_missing", "frame_timeout", "frame_late", "latency_high", "frame_stale")
CLOCK = reported("clock_backwards", "clock_jumped", "frame_missing", "frame_late", "latency_high", "frame_timeout")
GONE = reported("source_lost", "frame_missing", "frame_timeout")
MOVED_RECOVERS = BY_ITSELF | ARMED
"""A surface that moved as no skin can may have to be given its zero by a person."""

GONE_RECOVERS = NEW_SESSION | LATCHED


def of_camera(act: Act, *, is_step: bool = False) -> Inject:
    """Tell the camera something, and undo it a random time later; a step is over as soon as it was made."""

    def inject(rig: "Rig", chance: random.Random) -> Fault:
        receipt = act(rig.camera, chance)

        lasts_s = chance.uniform(*LASTS_S)
        return Fault(cause_ns=receipt.raised_ns, undo=rig.mend_camera, lasts_s=lasts_s, is_step=is_step)

    return inject


def cover_marker(rig: "Rig", chance: random.Random) -> Fault:
    """Lay a cloth on one of the four markers."""
    return of_camera(lambda camera, chance: camera.cover(chance.randrange(4)))(rig, chance)


def breath_too_large(rig: "Rig", chance: random.Random) -> Fault:
    """Lift the patient as fast as skin may move, until the signal leaves the window.

    Counted from the first frame that was measured outside; at the latest from the one that is outside wherever in the
    breath the patient, and the person who set the zero, were.
    """
    session_id, mm_a_frame = rig.person.session_id, chance.uniform(2.0, 3.2)
    receipt = rig.camera.lift(chance.uniform(55.0, 80.0), mm_a_frame=mm_a_frame)
    frames = math.ceil((rig.window_mm + BREATH_MM) / mm_a_frame)
    latest_ns = receipt.raised_ns + int(frames * PERIOD_MS * NS_PER_MS)

    def first_outside_ns() -> int | None:
        seen_ns = rig.ledger.first_outside_ns(session_id, receipt.raised_ns, rig.window_mm)
        return None if seen_ns is None else min(seen_ns, latest_ns)

    return Fault(
        cause_ns=latest_ns,
        begun_ns=receipt.raised_ns,
        undo=rig.mend_camera,
        lasts_s=chance.uniform(0.05, 0.4),
        find_cause=first_outside_ns,
    )


def slow(act: Callable[[VirtualXtion, float, float], Receipt], noticed_mm: float) -> Inject:
    """Move something slower than skin breathes; counted from the frame in which it is this far away, or from the off.

    The limit lies below, so that the beam may go off earlier than it has to.
    """

    def inject(rig: "Rig", chance: random.Random) -> Fault:
        mm_a_frame = chance.uniform(0.2, 1.0)
        receipt = act(rig.camera, chance.choice((-1.0, 1.0)) * chance.uniform(1.5, 3.0) * noticed_mm, mm_a_frame)
        latest_ns = receipt.raised_ns + int(math.ceil(noticed_mm / mm_a_frame) * PERIOD_MS * NS_PER_MS)

        def off_or_latest_ns() -> int | None:
            if time.monotonic_ns() < latest_ns:
                return None
            before = [edge for edge in rig.edges if edge.at_ns < latest_ns]
            return latest_ns if before[-1].is_on else before[-1].at_ns - 1

        return Fault(
            cause_ns=latest_ns,
            begun_ns=receipt.raised_ns,
            find_cause=off_or_latest_ns,
            undo=rig.mend_camera,
            lasts_s=chance.uniform(*LASTS_S),
        )

    return inject


def backlog(rig: "Rig", chance: random.Random) -> Fault:
    """Let each frame come a little later than the one before; counted from the first that comes later than it may."""
    growing_ms = chance.uniform(8.0, 24.0)
    receipt = rig.camera.late(0.0, growing_ms=growing_ms)
    believed = int(LAG_MS / growing_ms)
    late_ns = int((believed + 1) * PERIOD_MS * NS_PER_MS)
    return Fault(cause_ns=receipt.raised_ns + late_ns, undo=rig.mend_camera, lasts_s=chance.uniform(0.05, 0.5))


def hung_read(rig: "Rig", chance: random.Random) -> Fault:
    """Let the runtime's wait for a frame hang in the driver."""
    receipt = rig.camera.hang(Call.READ)
    return Fault(cause_ns=receipt.raised_ns, undo=rig.mend_camera, lasts_s=chance.uniform(0.05, 1.5))


def _sheet(camera: VirtualXtion, chance: random.Random) -> Receipt:
    """Lay something 10 to 40 mm thick on a part of the region."""
    left, top, width, height = camera.depth_rect(camera.region_rect)
    share = chance.uniform(0.35, 0.7)
    rect = (left, top, max(round(width * share), 1), max(round(height * share), 1))
    return camera.offset(-chance.uniform(10.0, 40.0), rect=rect)


def _thin_sheet(camera: VirtualXtion, chance: random.Random) -> Receipt:
    """Lay something 3 to 6 mm thin, of the colour of what it lies on, on half of the region."""
    left, top, width, height = camera.depth_rect(camera.region_rect)
    half = chance.choice(
        [
            (left, top, width // 2, height),
            (left + width // 2, top, width // 2, height),
            (left, top + height // 2, width, height // 2),
        ]
    )
    return camera.offset(-chance.uniform(3.0, 6.0), rect=half)


def _black_cover(camera: VirtualXtion, _chance: random.Random) -> Receipt:
    """Lay a black cloth over the whole region: it swallows the camera's infrared, so that nothing is read of it."""
    return camera.fill(depth_rect=camera.depth_rect(camera.region_rect), depth_mm=0, color_rect=camera.region_rect)


def _blanket(camera: VirtualXtion, chance: random.Random) -> Receipt:
    """Pull a blanket over the whole region: 8 to 25 mm nearer, and of one colour."""
    covered = camera.fill(color_rect=camera.region_rect, rgb=chance.choice(BLANKETS_RGB))
    camera.offset(-chance.uniform(8.0, 25.0), rect=camera.depth_rect(camera.region_rect))
    return covered


def _blind(camera: VirtualXtion, chance: random.Random) -> Receipt:
    """Read nothing in the lowest fifth to third of the region."""
    left, top, width, height = camera.depth_rect(camera.region_rect)
    rows = round(chance.uniform(0.2, 0.33) * height)
    return camera.dropout(1.0, rect=(left, top + height - rows, width, rows), is_same=True)


def _slide(camera: VirtualXtion, chance: random.Random) -> Receipt:
    """Let one marker slide by 8 to 14 pixels in any direction."""
    way, far_px = chance.uniform(0.0, 2.0 * math.pi), chance.uniform(8.0, 14.0)
    return camera.slide(chance.randrange(4), round(far_px * math.cos(way)), round(far_px * math.sin(way)))


def _shift(camera: VirtualXtion, chance: random.Random) -> Receipt:
    right_px, down_px = chance.choice([(12, 0), (-12, 0), (0, 12), (0, -12), (9, 9), (-15, 6)])
    return camera.shift(right_px, down_px)


def _kind(
    code: str, what: str, inject: Inject, names: frozenset[str], recoveries: frozenset[Recovery] = BY_ITSELF, **more
):
    return FaultKind(code=code, what=what, family=FAMILY, inject=inject, reported=names, recoveries=recoveries, **more)


def _camera(
    code: str,
    what: str,
    act: Act,
    names: frozenset[str],
    recoveries: frozenset[Recovery] = BY_ITSELF,
    *,
    is_step: bool = False,
    **more,
):
    return _kind(code, what, of_camera(act, is_step=is_step), names, recoveries, **more)


KINDS = (
    _camera("marker-covered", "a marker is covered", lambda camera, chance: camera.cover(chance.randrange(4)), HIDDEN),
    _camera(
        "marker-slides",
        "a marker slides by 8 to 14 pixels",
        _slide,
        HIDDEN | reported("patient_shifted"),
        MOVED_RECOVERS,
    ),
    _camera(
        "hand-in-view",
        "a hand over the region",
        lambda camera, chance: camera.hand(depth_mm=chance.randrange(550, 760), share=chance.uniform(0.35, 0.9)),
        OBJECT | HIDDEN | UNREAD,
    ),
    _camera("sheet", "a sheet of 10 to 40 mm on a part of the region", _sheet, OBJECT, MOVED_RECOVERS),
    _camera(
        "body-jumps",
        "the whole body is 8 to 25 mm higher or lower at once",
        lambda camera, chance: camera.lift(chance.choice((-1, 1)) * chance.uniform(8.0, 25.0)),
        MOVED | reported("outside_window"),
        MOVED_RECOVERS,
        is_step=True,
    ),
    _camera(
        "patient-shifts", "the patient slides on the couch", _shift, MOVED | reported("residual_high"), MOVED_RECOVERS
    ),
    _kind(
        "breath-too-large",
        "the body rises out of the window at a breath's speed",
        breath_too_large,
        MOVED | reported("outside_window"),
        MOVED_RECOVERS,
        plan=ANY_HEIGHT,
    ),
    _camera(
        "sheet-thin",
        "a sheet of 3 to 6 mm, of the skin's colour, on half of the region",
        _thin_sheet,
        OBJECT,
        MOVED_RECOVERS,
        **AVERAGED,
    ),
    _kind(
        "body-settles",
        "the body rises or sinks slowly by more than 3 mm",
        slow(lambda camera, mm, mm_a_frame: camera.lift(mm, mm_a_frame=mm_a_frame), 4.0),
        MOVED,
        MOVED_RECOVERS,
        **AVERAGED,
    ),
    _kind(
        "camera-sinks",
        "the camera sinks or rises slowly by more than 1.5 mm",
        slow(lambda camera, mm, mm_a_frame: camera.offset(mm, mm_a_frame=mm_a_frame), 2.5),
        CAMERA,
        MOVED_RECOVERS,
        **AVERAGED,
    ),
    _kind(
        "camera-warms",
        "the camera reads slowly farther or nearer in proportion to the distance, by more than 2 mm a metre",
        slow(lambda camera, mm, mm_a_frame: camera.warm(mm, mm_a_frame=mm_a_frame), 2.5),
        CAMERA,
        MOVED_RECOVERS,
        **AVERAGED,
    ),
    _camera(
        "camera-jolted",
        "the camera is 3 to 20 mm nearer or farther at once",
        lambda camera, chance: camera.offset(chance.choice((-1, 1)) * chance.uniform(3.0, 20.0)),
        CAMERA,
        MOVED_RECOVERS,
        **AVERAGED,
    ),
    _camera(
        "black-cover",
        "a black cloth over the whole region, of which nothing is read",
        _black_cover,
        HIDDEN | UNREAD,
        MOVED_RECOVERS,
    ),
    _camera("blanket", "a blanket over the whole region", _blanket, HIDDEN | OBJECT, MOVED_RECOVERS),
    _camera("part-blind", "the lowest fifth to third of the region is not read", _blind, reported("coverage_low")),
    _camera("depth-zero", "no pixel of depth is read", lambda camera, _: camera.flat(0), UNREAD | FROZEN),
    _camera(
        "depth-holes",
        "half to nine tenths of the pixels read nothing",
        lambda camera, chance: camera.dropout(chance.uniform(0.5, 0.9), is_same=chance.random() < 0.5),
        reported("coverage_low"),
    ),
    _camera("depth-noise", "depth is noise", lambda camera, _: camera.noise(), UNREAD | reported("value_invalid")),
    _camera(
        "depth-65535",
        "every pixel reads 65535",
        lambda camera, _: camera.flat(65_535),
        UNREAD | FROZEN | reported("value_invalid"),
    ),
    _camera(
        "depth-flat",
        "every pixel reads one distance",
        lambda camera, chance: camera.flat(chance.randrange(500, 1500)),
        UNREAD | FROZEN,
    ),
    _camera(
        "picture-frozen",
        "the same pictures with new times",
        lambda camera, _: camera.repeat(),
        FROZEN,
    ),
    _camera(
        "depth-frozen",
        "the same depth with new times",
        lambda camera, _: camera.repeat(Streams.DEPTH),
        FROZEN,
    ),
    _camera(
        "color-frozen",
        "the same colour with new times",
        lambda camera, _: camera.repeat(Streams.COLOR),
        FROZEN,
    ),
    _camera(
        "picture-torn",
        "the lower part of both pictures is 2 to 8 frames old",
        lambda camera, chance: camera.tear(chance.randrange(120, 300), chance.randrange(2, 9)),
        FROZEN,
    ),
    _camera(
        "depth-averaged",
        "a filter in time: the depth is the mean of 4 to 8 frames",
        lambda camera, chance: camera.average(chance.randrange(4, 9)),
        FROZEN,
        bound="by the noise of the last fifth of a second: found within 700 ms, then 100 ms",
        bound_ms=700.0 + FRAME_MS,
    ),
    _camera("frame-again", "the same frame again, with its old time", lambda camera, _: camera.again(), CLOCK, LATCHED),
    _camera("both-stall", "no frame comes any more", lambda camera, _: camera.stall(), SILENT),
    _camera("depth-stalls", "no depth comes any more", lambda camera, _: camera.stall(Streams.DEPTH), SILENT),
    _camera(
        "color-stalls",
        "no colour comes any more",
        lambda camera, _: camera.stall(Streams.COLOR),
        reported("marker_lost"),
        bound="a colour picture may be 100 ms off its depth, then 100 ms",
        bound_ms=100.0 + FRAME_MS,
    ),
    _camera(
        "frames-skipped",
        "one to five frames are lost",
        lambda camera, chance: camera.skip(chance.randrange(1, 6)),
        SILENT,
        is_step=True,
    ),
    _camera(
        "frames-late",
        "frames come 110 to 400 ms late",
        lambda camera, chance: camera.late(chance.uniform(110.0, 400.0)),
        SILENT,
    ),
    _kind(
        "backlog-grows",
        "each frame comes 8 to 24 ms later than the one before",
        backlog,
        SILENT,
        bound="a frame may be 100 ms late, then 100 ms",
        bound_ms=LAG_MS + FRAME_MS,
    ),
    _camera(
        "rate-halved",
        "5 to 15 frames a second",
        lambda camera, chance: camera.rate(chance.uniform(5.0, 15.0)),
        SILENT | reported("frame_rate_low"),
    ),
    _camera(
        "rate-low",
        "17.5 to 18.5 frames a second",
        lambda camera, chance: camera.rate(chance.uniform(17.5, 18.5)),
        SILENT | reported("frame_rate_low"),
        bound="counted over a second, then 100 ms",
        bound_ms=1000.0 + FRAME_MS,
    ),
    _camera(
        "clock-back",
        "the camera's clock goes back",
        lambda camera, chance: camera.clock(-round(chance.uniform(5e4, 5e6))),
        CLOCK,
        LATCHED,
    ),
    _camera(
        "clock-jumps",
        "the camera's clock jumps ahead",
        lambda camera, chance: camera.clock(round(chance.uniform(3e5, 5e6))),
        CLOCK,
        LATCHED,
    ),
    _camera("clock-stands", "the camera's clock stands still", lambda camera, _: camera.stuck_clock(), CLOCK, LATCHED),
    _camera(
        "device-error", "the device tells an error", lambda camera, _: camera.state(State.ERROR), GONE, GONE_RECOVERS
    ),
    _camera(
        "device-not-ready",
        "the device tells it is not ready",
        lambda camera, _: camera.state(State.NOT_READY),
        GONE,
        GONE_RECOVERS,
    ),
    _camera("unplugged", "the camera is unplugged", lambda camera, _: camera.unplug(), GONE, GONE_RECOVERS),
    _camera(
        "unplugged-silently",
        "the camera is unplugged without an event of the runtime",
        lambda camera, chance: camera.unplug(is_reported=False, streams_go_on=chance.random() < 0.5),
        GONE | SILENT,
        GONE_RECOVERS | BY_ITSELF,
    ),
    _kind(
        "native-read-hangs",
        "a wait for frames hangs in the driver",
        hung_read,
        SILENT | reported("watchdog"),
        GONE_RECOVERS | BY_ITSELF,
    ),
)
