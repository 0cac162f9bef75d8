"""What the virtual Xtion shows, as the product's own live source reads it out of the real runtime."""

import threading
import zlib
from itertools import pairwise

import numpy as np
import pytest

from lab.phantom.sensor import depth_table_mm
from tests.support.virtual_camera.block import Streams
from tests.support.virtual_camera.viewer import Onlooker, look

pytestmark = pytest.mark.alone


def crcs(film):
    pairs = [film.pictures(frame) for frame in range(film.frames)]
    return (
        {zlib.crc32(depth): frame for frame, (depth, _) in enumerate(pairs)},
        {zlib.crc32(color): frame for frame, (_, color) in enumerate(pairs)},
    )


def seen(camera, tmp_path, *words):
    look(camera, "pictures", str(tmp_path / "seen.npz"), *words)
    with np.load(tmp_path / "seen.npz") as file:
        return int(file["index"]), file["depth_mm"], file["color"]


def test_it_is_listed_as_a_camera_and_plays_baked_frames_bit_for_bit_across_the_seam(camera):
    assert look(camera, "devices") == [{"uri": "virtual/xtion", "vendor": "Tidegate", "name": "Virtual Xtion"}]
    depth_at, color_at = crcs(camera.film)
    with Onlooker(camera) as onlooker:
        onlooker.until_frame(camera.film.frames + 30)
    assert onlooker.said[0] == {
        "kind": "openni",
        "name": "Virtual Xtion",
        "depth_size": [640, 480],
        "fps": 30.0,
        "is_live": True,
    }
    frames = onlooker.frames
    at = [(depth_at[frame["depth_crc"]], frame["device_index"]) for frame in frames]
    assert {(position - index) % camera.film.frames for position, index in at} == {(at[0][0] - at[0][1]) % 348}
    assert {position for position, _ in at} >= {0, camera.film.frames - 1}
    steps_us = {
        (after["timestamp_us"] - before["timestamp_us"]) // (after["device_index"] - before["device_index"])
        for before, after in pairwise(frames)
    }
    assert steps_us <= {33_366, 33_367}
    assert all(frame["color_crc"] in color_at for frame in frames)


def test_it_is_one_process_s_at_a_time(camera):
    with Onlooker(camera):
        assert len(look(camera, "devices")) == 1
        second = Onlooker(camera)
        try:
            second.until(lambda: not second.is_alive, "a refusal")
            assert second.frames == []
        finally:
            second.__exit__()
    assert len(look(camera, "frames", "0.5")) > 5


def test_pictures_are_not_mirrored_though_the_camera_mirrors_by_itself(camera, tmp_path):
    _, depth_mm, color = seen(camera, tmp_path)
    depth_at, color_at = crcs(camera.film)
    assert zlib.crc32(np.ascontiguousarray(depth_mm)) in depth_at
    assert zlib.crc32(np.ascontiguousarray(color)) in color_at
    assert camera.status.is_mirrored == (False, False)


def test_half_size_is_every_second_pixel(camera, tmp_path):
    _, depth_mm, color = seen(camera, tmp_path, "small")
    assert (depth_mm.shape, color.shape) == ((240, 320), (240, 320, 3))
    assert any(np.array_equal(camera.film.pictures(at)[0][::2, ::2], depth_mm) for at in range(camera.film.frames))
    assert any(np.array_equal(camera.film.pictures(at)[1][::2, ::2], color) for at in range(camera.film.frames))


def registered(film, at):
    """The film's depth picture at this frame, moved into the colour camera's view; and the picture itself."""
    depth_mm, _ = film.pictures(at)
    calibration = film.calibration
    rows, columns = np.nonzero(depth_mm)
    points = calibration.depth.rays(np.column_stack([columns, rows]).astype(float)) * depth_mm[rows, columns, None]
    pixels = np.rint(calibration.color.project(calibration.color_from_depth.apply(points))).astype(int)
    inside = ((pixels >= 0) & (pixels < (640, 480))).all(axis=1)
    expected = np.full((480, 640), 65535, np.uint16)
    np.minimum.at(expected, (pixels[inside, 1], pixels[inside, 0]), depth_mm[rows, columns][inside])
    expected[expected == 65535] = 0
    return expected, depth_mm


def test_registration_moves_depth_to_where_the_colour_camera_sees_it(camera, tmp_path):
    _, registered_mm, color = seen(camera, tmp_path, "registered")
    _, color_at = crcs(camera.film)
    at = color_at[zlib.crc32(np.ascontiguousarray(color))]
    # The colour picture in hand is that of the depth frame or of an earlier one, by how busy the machine is.
    found = [registered(camera.film, (at + later) % camera.film.frames) for later in range(4)]
    expected, depth_mm = max(found, key=lambda one: (one[0] == registered_mm).mean())
    assert (expected == registered_mm).mean() > 0.99
    assert (depth_mm == registered_mm).mean() < 0.6


RECT = (200, 150, 60, 40)
INSIDE = (slice(150, 190), slice(200, 260))


def shot(camera, tmp_path, order):
    """Read one picture while an order stands: given as soon as somebody streams."""

    def give():
        camera.await_streaming()
        order()

    giver = threading.Thread(target=give)
    giver.start()
    try:
        return seen(camera, tmp_path)
    finally:
        giver.join()


def origin(camera, color):
    _, color_at = crcs(camera.film)
    return (color_at[zlib.crc32(np.ascontiguousarray(color))] + 1) % camera.film.frames


def test_an_offset_keeps_to_the_sensor_s_steps_and_is_right_on_average(camera, tmp_path):
    _, depth_mm, color = shot(camera, tmp_path, lambda: camera.offset(-7.0, rect=RECT))
    before, _ = camera.film.pictures(origin(camera, color))
    outside = np.ones(before.shape, bool)
    outside[INSIDE] = False
    assert np.array_equal(depth_mm[outside], before[outside])
    moved = depth_mm[INSIDE].astype(float) - before[INSIDE]
    assert moved[before[INSIDE] > 0].mean() == pytest.approx(-7.0, abs=0.15)
    assert set(np.unique(depth_mm[INSIDE])) - {0} <= set(np.unique(before)) | set(_steps())
    assert (depth_mm[INSIDE][before[INSIDE] == 0] == 0).all()


def _steps():
    return depth_table_mm().tolist()


def test_a_filled_rectangle_is_filled_and_nothing_else(camera, tmp_path):
    _, depth_mm, color = shot(
        camera, tmp_path, lambda: camera.fill(depth_rect=RECT, depth_mm=700, color_rect=RECT, rgb=0x102030)
    )
    assert (depth_mm[INSIDE] == 700).all()
    assert (color[INSIDE] == (0x10, 0x20, 0x30)).all()
    assert (depth_mm == 700).sum() < 60 * 40 + 100
    assert not (color[:150] == (0x10, 0x20, 0x30)).all(axis=2).any()


def test_dropped_pixels_read_nothing_in_the_share_asked_for(camera, tmp_path):
    _, depth_mm, color = shot(camera, tmp_path, lambda: camera.dropout(0.3))
    before, _ = camera.film.pictures(origin(camera, color))
    assert ((depth_mm == 0) | (depth_mm == before)).all()
    assert (depth_mm[before > 0] == 0).mean() == pytest.approx(0.3, abs=0.01)


def test_a_shift_moves_both_pictures(camera, tmp_path):
    _, depth_mm, color = shot(camera, tmp_path, lambda: camera.shift(5, -3))
    films = [camera.film.pictures(at) for at in range(camera.film.frames)]
    assert any(np.array_equal(depth_mm[:-3, 5:], depth[3:, :-5]) for depth, _ in films)
    assert any(np.array_equal(color[:-3, 5:], picture[3:, :-5]) for _, picture in films)


@pytest.mark.parametrize(
    ("name", "low", "high"), [("flat", 0, 0), ("far", 65535, 65535), ("noise", 400, 4000)], ids=["flat", "far", "noise"]
)
def test_nonsense_depth_is_delivered_as_requested(camera, tmp_path, name, low, high):
    orders = {"flat": lambda: camera.flat(0), "far": lambda: camera.flat(65535), "noise": camera.noise}
    _, depth_mm, _ = shot(camera, tmp_path, orders[name])
    assert low <= int(depth_mm.min()) <= int(depth_mm.max()) <= high
    if name == "noise":
        assert depth_mm.std() > 900.0


def test_a_held_breath_shows_one_moment_and_never_the_same_picture(camera):
    with Onlooker(camera) as onlooker:
        receipt = camera.breathe(0.0, position=camera.film.inhaled)
        onlooker.until_frame(receipt.frame_index + 20)
        assert camera.status.position == camera.film.inhaled
    held = [frame for frame in onlooker.frames if frame["device_index"] >= receipt.frame_index]
    assert len({frame["depth_crc"] for frame in held}) == len(held)
    assert max(frame["center_mm"] for frame in held) - min(frame["center_mm"] for frame in held) <= 2.0


def test_a_breath_twice_as_fast_takes_half_the_frames(camera):
    with Onlooker(camera) as onlooker:
        camera.breathe(2.0, position=0)
        first = camera.status
        onlooker.until_frame(first.index[0] + 20)
        last = camera.status
    assert abs((last.position - first.position) - 2 * (last.ticks - first.ticks)) <= 4


def test_edits_of_one_stream_leave_the_other(camera, tmp_path):
    _, depth_mm, color = shot(camera, tmp_path, lambda: camera.noise(streams=Streams.COLOR))
    depth_at, color_at = crcs(camera.film)
    assert zlib.crc32(np.ascontiguousarray(depth_mm)) in depth_at
    assert zlib.crc32(np.ascontiguousarray(color)) not in color_at


def test_a_cloth_lies_on_one_marker_alone(camera, tmp_path):
    _, _, color = shot(camera, tmp_path, lambda: camera.cover(2))
    centers = np.rint(camera.film.truth["markers_px"].mean(axis=0)).astype(int)
    brightness = [int(color[row, column].sum()) for column, row in centers]
    assert [brightness.index(min(brightness)), sum(level > 450 for level in brightness)] == [2, 3]


def test_a_hand_is_where_it_is_in_both_pictures(camera, tmp_path):
    _, depth_mm, color = shot(camera, tmp_path, camera.hand)
    rows, columns = np.nonzero(depth_mm == 700)
    calibration = camera.film.calibration
    points = calibration.depth.rays(np.column_stack([columns, rows]).astype(float)) * 700.0
    pixels = np.rint(calibration.color.project(calibration.color_from_depth.apply(points))).astype(int)
    is_skin = (color[pixels[:, 1], pixels[:, 0]] == (0xE0, 0xAC, 0x8C)).all(axis=1)
    assert len(rows) > 2000
    assert is_skin.mean() > 0.95
