"""The same picture again with new times is old; delivered again with its old time it is not."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import LostReason, RgbdFrame
from engine.motion.tracking.repeated_pictures import (
    EARLIER_PICTURES,
    LEAST_READINGS,
    THINNING_PX,
    RepeatedPictures,
)
from tests.support.gating.streams import PERIOD_NS, PERIOD_US, START_NS

NOISE = np.random.default_rng(7)
DEPTHS = [NOISE.integers(700, 900, (48, 64)).astype(np.uint16) for _ in range(120)]
COLORS = [NOISE.integers(1, 255, (48, 64, 3)).astype(np.uint8) for _ in range(120)]


def frame(
    index: int, *, depth: int | None = None, color: int | None = None, color_time: int | None = None
) -> RgbdFrame:
    """Frame ``index`` with the pictures of the given frames; its own by default."""
    return RgbdFrame(
        index=index,
        device_index=index,
        timestamp_us=index * PERIOD_US,
        color_timestamp_us=(index if color_time is None else color_time) * PERIOD_US,
        received_ns=START_NS + index * PERIOD_NS,
        depth_mm=DEPTHS[index if depth is None else depth].copy(),
        color=COLORS[index if color is None else color].copy(),
    )


def reasons(frames):
    repeats = RepeatedPictures()
    found = [repeats.check(one) for one in frames]
    return [None if one is None else one.reason for one in found]


def test_pictures_that_differ_are_new():
    assert reasons(frame(index) for index in range(20)) == [None] * 20


@pytest.mark.parametrize("stream", ["depth", "color"])
def test_the_same_picture_again_is_old_and_a_new_one_is_not(stream):
    frames = [frame(0), frame(1), frame(2, **{stream: 1}), frame(3, **{stream: 1}), frame(4)]
    assert reasons(frames) == [None, None, LostReason.FRAME_FROZEN, LostReason.FRAME_FROZEN, None]


@pytest.mark.parametrize("stream", ["depth", "color"])
@pytest.mark.parametrize("buffers", [2, 8, 64, 96])
def test_old_pictures_that_take_turns_are_old(stream, buffers):
    frames = [frame(index, **{stream: index % buffers}) for index in range(buffers + 20)]
    found = reasons(frames)
    assert found[:buffers] == [None] * buffers
    assert set(found[buffers:]) == {LostReason.FRAME_FROZEN}


def test_a_colour_picture_delivered_again_with_its_old_time_is_no_repetition():
    slow = [frame(index, color=index // 2, color_time=index // 2 * 2) for index in range(12)]
    assert reasons(slow) == [None] * 12


def test_a_repeated_colour_picture_is_counted_across_frames_that_bring_none():
    frames = [frame(0), frame(1, color=0, color_time=1), frame(2, color=0, color_time=1)]
    assert reasons(frames) == [None, LostReason.FRAME_FROZEN, LostReason.FRAME_FROZEN]


@pytest.mark.parametrize(("row", "column"), [(0, 0), (1, 1), (THINNING_PX, THINNING_PX), (47, 63)])
def test_one_pixel_anywhere_makes_another_picture(row, column):
    second = frame(1, depth=0)
    changed = second.depth_mm.copy()
    changed[row, column] += 1
    assert reasons([frame(0), replace(second, depth_mm=changed)]) == [None, None]


def test_a_camera_that_sees_nothing_is_not_called_frozen():
    """A covered lens reads nothing at all, again and again: the frame is lost for that, and reports it."""
    empty = [replace(frame(index), depth_mm=np.zeros((48, 64), np.uint16)) for index in range(4)]
    assert reasons(empty) == [None] * 4


def test_pictures_of_another_size_are_other_pictures():
    assert reasons([frame(0), replace(frame(1), depth_mm=DEPTHS[0][:24].copy())]) == [None, None]


LARGE = (480, 640)
"""Large enough for a share of agreeing readings to tell."""


def still(index: int, share: float, seed: int = 0) -> RgbdFrame:
    """A frame of which about ``share`` of the depth readings are those of the same scene, the others a step away."""
    scene = np.random.default_rng(seed).integers(700, 900, LARGE).astype(np.uint16)
    changes = np.random.default_rng((seed, index)).random(LARGE) >= share
    return replace(frame(index % 40), index=index, **times(index), depth_mm=scene + changes * np.uint16(2 + index % 3))


def times(index: int) -> dict[str, int]:
    return {
        "timestamp_us": index * PERIOD_US,
        "color_timestamp_us": index * PERIOD_US,
        "received_ns": START_NS + index * PERIOD_NS,
    }


def with_own_color(one: RgbdFrame) -> RgbdFrame:
    color = np.random.default_rng(one.index).integers(1, 255, (48, 64, 3)).astype(np.uint8)
    return replace(one, color=color)


@pytest.mark.parametrize("flicker", [0.0, 0.01, 0.05])
def test_a_frozen_picture_that_flickers_is_old(flicker):
    found = reasons(with_own_color(still(index, 1.0 - flicker)) for index in range(12))
    assert found == [None] + [LostReason.FRAME_FROZEN] * 11


def test_old_pictures_that_take_turns_and_flicker_are_old():
    ring = [still(index % 9, 1.0, seed=index % 9).depth_mm for index in range(9)]
    shown = [replace(still(index, 0.99, seed=index % 9), depth_mm=ring[index % 9]) for index in range(9)]
    shown += [still(index, 0.99, seed=index % 9) for index in range(9, 20)]
    assert reasons(map(with_own_color, shown)) == [None] * 9 + [LostReason.FRAME_FROZEN] * 11


def test_a_still_scene_whose_readings_agree_as_much_as_a_sensors_do_is_not_old():
    assert reasons(with_own_color(still(index, 0.7)) for index in range(60)) == [None] * 60


def test_pictures_with_few_readings_are_compared_exactly():
    scene = still(0, 1.0).depth_mm
    mostly_empty = np.where(np.arange(LARGE[0])[:, None] < 60, scene, np.uint16(0))
    changed = mostly_empty.copy()
    changed[0, 0] += 1
    first, second = (replace(frame(index), depth_mm=depth) for index, depth in enumerate((mostly_empty, changed)))
    assert reasons([first, second]) == [None, None]


def test_holes_do_not_count_as_agreeing_readings():
    scene = still(0, 1.0).depth_mm
    half = np.where(np.arange(LARGE[1]) < 320, scene, np.uint16(0))
    other = half + (half > 0) * np.uint16(1)
    first, second = (replace(frame(index), depth_mm=depth) for index, depth in enumerate((half, other)))
    assert reasons([first, second]) == [None, None]


def test_pictures_in_memory_that_is_used_again_are_compared_with_what_they_were():
    buffer = np.empty(LARGE, dtype=np.uint16)

    def in_buffer(index):
        buffer.setflags(write=True)
        buffer[:] = still(index, 0.5, seed=index).depth_mm
        return with_own_color(replace(still(index, 0.5), depth_mm=buffer))

    assert reasons(in_buffer(index) for index in range(5)) == [None] * 5


def of_readings(index, readings):
    """A frame whose thinned depth picture has these readings."""
    depth_mm = np.kron(readings.astype(np.uint16), np.ones((THINNING_PX, THINNING_PX), dtype=np.uint16))
    return with_own_color(replace(frame(index % 40), index=index, **times(index), depth_mm=depth_mm))


@pytest.mark.parametrize(("agreeing", "is_old"), [(352, True), (351, False)])
def test_a_picture_is_old_from_the_share_of_agreeing_readings_itself(agreeing, is_old):
    """Of 400 readings, 88 per cent."""
    readings = np.random.default_rng(1).integers(700, 900, (20, 20))
    other = readings.copy()
    other.flat[agreeing:] += 1
    assert reasons([of_readings(0, readings), of_readings(1, other)]) == [
        None,
        LostReason.FRAME_FROZEN if is_old else None,
    ]


@pytest.mark.parametrize(("count", "is_old"), [(LEAST_READINGS, True), (LEAST_READINGS - 1, False)])
def test_as_many_readings_as_are_needed_tell_a_share(count, is_old):
    readings = np.zeros((20, 20), dtype=np.int64)
    readings.flat[:count] = np.random.default_rng(1).integers(700, 900, count)
    other = readings.copy()
    other[0, 0] += 1
    found = reasons([of_readings(0, readings), of_readings(1, other)])
    assert found == [None, LostReason.FRAME_FROZEN if is_old else None]


@pytest.mark.parametrize("ago", [1, 2, EARLIER_PICTURES - 1, EARLIER_PICTURES])
def test_each_of_the_earlier_pictures_is_remembered_and_no_older_one(ago):
    pictures = [np.random.default_rng(seed).integers(700, 900, (20, 20)) for seed in range(2 * EARLIER_PICTURES)]
    shown = [of_readings(index, readings) for index, readings in enumerate(pictures)]
    nearly = pictures[len(pictures) - ago].copy()
    nearly[0, 0] += 1
    older = pictures[len(pictures) - EARLIER_PICTURES - 1].copy()
    older[0, 0] += 1
    repeats = RepeatedPictures()
    assert {repeats.check(one) for one in shown} == {None}
    assert repeats.check(of_readings(len(shown), older)) is None
    repeats = RepeatedPictures()
    assert {repeats.check(one) for one in shown} == {None}
    assert repeats.check(of_readings(len(shown), nearly)).reason is LostReason.FRAME_FROZEN


def test_colours_that_nearly_agree_are_no_repetition():
    def shown(index):
        color = np.full((20 * THINNING_PX, 20 * THINNING_PX, 3), 90, dtype=np.uint8)
        color[index * THINNING_PX, 0] += 1
        return replace(frame(index), color=color)

    assert reasons(shown(index) for index in range(12)) == [None] * 12


@pytest.mark.parametrize(("stream", "name"), [("depth", "depth"), ("color", "colour")])
def test_a_loss_names_the_stream_and_how_often(stream, name):
    repeats = RepeatedPictures()
    found = [repeats.check(frame(index, **{stream: 0})) for index in range(4)]
    assert [None if one is None else one.detail for one in found] == [
        None,
        *(f"the {name} picture is repeated ({count})" for count in (1, 2, 3)),
    ]


def test_a_colour_picture_with_its_old_time_is_no_silence_however_long_it_lasts():
    assert reasons(frame(index, color=0, color_time=0) for index in range(100)) == [None] * 100


TORN = np.random.default_rng(11)
BASE_MM = np.tile(np.linspace(700.0, 1300.0, 320), (240, 1))


def noisy(count):
    """Depth pictures of a still scene whose readings change as often as a real camera's: a third of them."""
    return [(BASE_MM + 3.0 * TORN.integers(0, 2, BASE_MM.shape)).astype(np.uint16) for _ in range(count)]


def torn(pictures, onset, rows, columns, lag):
    """From the onset on a part of each picture is so many pictures old; None: it stays as it was."""
    shown = []
    for index, picture in enumerate(pictures):
        old = pictures[onset - 1 if lag is None else max(index - lag, 0)]
        now = picture.copy()
        if index >= onset:
            now[rows, columns] = old[rows, columns]
        shown.append(replace(frame(index), depth_mm=now))
    return reasons(shown)


PARTS = {
    "lower half": (slice(120, 240), slice(0, 320)),
    "a side": (slice(0, 240), slice(160, 320)),
    "a tile": (slice(60, 120), slice(80, 160)),
}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("lag", [1, 4, 8])
def test_a_picture_that_is_old_in_part_is_old_for_as_long_as_it_lags(part, lag):
    with_colors = 70
    found = torn(noisy(with_colors), 50, *PARTS[part], lag)
    assert found[:50] == [None] * 50
    assert found[50 : 50 + lag] == [LostReason.FRAME_TORN] * lag


def test_with_few_readings_no_part_tells_anything():
    """Two of sixteen tiles are seen, and one of them lags."""
    pictures = noisy(70)
    for picture in pictures:
        picture[:60], picture[120:], picture[60:120, 160:] = 0, 0, 0
    assert {*torn(pictures, 50, *PARTS["a tile"], 4)} == {None}


def test_a_part_that_is_frozen_for_good_is_old_in_every_picture():
    found = torn(noisy(80), 50, *PARTS["lower half"], None)
    assert found == [None] * 50 + [LostReason.FRAME_TORN] * 30


def test_a_part_that_never_changes_tells_nothing_and_one_that_hardly_does_is_not_old():
    """A plate without noise; and a far wall, of which nineteen of twenty readings are the same again."""
    pictures = noisy(100)
    calm = TORN.random((100, 240, 160)) < 0.05
    for index, picture in enumerate(pictures):
        picture[:120, :160] = 900
        picture[120:, :160] = 2000 + 30 * calm[index, :120]
    assert {*reasons(replace(frame(index), depth_mm=one) for index, one in enumerate(pictures))} == {None}


def test_a_part_that_brings_no_new_picture_every_fourth_time_tells_nothing():
    pictures = noisy(100)
    for index in range(4, 100, 4):
        pictures[index][PARTS["a tile"]] = pictures[index - 1][PARTS["a tile"]]
    assert {*reasons(replace(frame(index), depth_mm=one) for index, one in enumerate(pictures))} == {None}
