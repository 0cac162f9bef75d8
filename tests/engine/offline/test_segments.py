"""Segments of a recording: each movement of patient, couch or camera ends one, and is given as six numbers."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.clock import US_PER_S
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BodyPosition, Lost, LostReason, MeasurementState
from engine.offline.segments import COLUMNS, Segments
from tests.support.gating.streams import measured, motion_of

ROWS, ACROSS = np.meshgrid(
    np.linspace(-150.0, 150.0, NODE_ROWS), np.linspace(-100.0, 100.0, NODE_COLUMNS), indexing="ij"
)
FLAT_MM = np.stack([ACROSS.ravel(), ROWS.ravel(), np.full(ROWS.size, 850.0)], axis=1)
FPS = 30


def frame(index, *, x_mm=0.0, y_mm=0.0, turn_deg=0.0, height_mm=0.0, doubt=None, lost=None):
    turn = np.deg2rad(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    surface_mm = FLAT_MM @ rotation.T + np.array([x_mm, y_mm, -height_mm])
    position = BodyPosition(measured_us=0, height_mm=height_mm, tilt_deg=0.5, roll_deg=-0.25)
    found = replace(
        measured(index, replace(motion_of(), surface_mm=surface_mm)),
        timestamp_us=index * US_PER_S // FPS,
        position=position,
        doubt=None if doubt is None else Lost(reason=doubt, detail=""),
    )
    if lost is None:
        return found
    return replace(found, state=MeasurementState.LOST, motion=None, position=None, lost=Lost(reason=lost, detail=""))


def followed(frames):
    segments = Segments()
    return [segments.follow(one) for one in frames], segments.summary()


def test_a_patient_who_lies_still_is_one_segment_with_six_numbers_a_frame():
    rows, (only,) = followed([frame(index, x_mm=0.5, height_mm=0.2) for index in range(60)])
    assert {row[0] for row in rows} == {"0"}
    assert rows[-1] == ["0", "", "0.000", "0.000", "0.200", "0.500", "-0.250", "0.000"]
    assert len(rows[0]) == len(COLUMNS)
    assert (only.cause, only.first_frame, only.last_frame, only.measured) == ("start", 0, 59, 60)
    assert only.moved["tilt_deg"] == 0.5


@pytest.mark.parametrize(
    ("moved", "numbers"),
    [
        ({"x_mm": 7.0, "y_mm": -12.0}, {"shift_x_mm": 7.0, "shift_y_mm": -12.0}),
        ({"turn_deg": 3.4}, {"turn_deg": 3.4}),
        ({"height_mm": 4.0}, {"height_mm": 4.0}),
    ],
)
def test_a_movement_beyond_a_limit_is_another_segment_with_its_size(moved, numbers):
    _, (before, after) = followed([frame(index, **(moved if index >= 90 else {})) for index in range(200)])
    assert (before.cause, before.last_frame) == ("start", 89)
    assert (after.cause, after.first_frame, after.measured) == ("patient_shifted", 90, 110)
    for name, value in numbers.items():
        assert after.moved[name] == pytest.approx(value, abs=0.01)


def test_a_slide_that_takes_its_time_is_one_movement():
    shares = np.clip((np.arange(240) - 90) / 60.0, 0.0, 1.0)
    _, (_, after) = followed([frame(index, y_mm=20.0 * share) for index, share in enumerate(shares)])
    assert after.cause == "patient_shifted"
    assert after.moved["shift_y_mm"] == pytest.approx(20.0, abs=0.01)


def test_within_the_limits_nothing_ends():
    moved = {"y_mm": 5.9, "turn_deg": 2.9}
    _, segments = followed([frame(index, **(moved if index >= 90 else {})) for index in range(120)])
    assert len(segments) == 1


def test_a_camera_that_moves_begins_a_segment_and_its_return_another():
    doubts = [LostReason.CAMERA_MOVED if 30 <= index < 60 else None for index in range(90)]
    rows, segments = followed([frame(index, doubt=doubt) for index, doubt in enumerate(doubts)])
    assert [row[1] for row in rows] == ["" if doubt is None else "camera_moved" for doubt in doubts]
    assert [(one.cause, one.first_frame) for one in segments] == [
        ("start", 0),
        ("camera_moved", 30),
        ("camera_moved", 60),
    ]


@pytest.mark.parametrize(("frames", "count"), [(FPS, 1), (FPS + 2, 2)])
def test_a_loss_of_more_than_a_second_ends_a_segment_by_its_name(frames, count):
    lost = [LostReason.SURFACE_CHANGED if 30 <= index < 30 + frames else None for index in range(120)]
    rows, segments = followed([frame(index, lost=one) for index, one in enumerate(lost)])
    assert rows[30] == ["0", "surface_changed", *[""] * 6]
    assert len(segments) == count
    assert segments[-1].cause == ("start" if count == 1 else "surface_changed")


def test_what_is_not_measured_has_no_numbers():
    _, (only,) = followed([frame(index, lost=LostReason.MARKER_LOST) for index in range(3)])
    assert (only.measured, only.moved) == (0, None)
