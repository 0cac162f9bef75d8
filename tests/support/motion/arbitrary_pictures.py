"""Pictures that no patient makes: rooms, noise, covered and blinded cameras, patterns, and frames damaged at random.

Everything comes from one random generator, so a seed and the kinds' names give the same pictures again.
"""

from dataclasses import replace

import cv2
import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import MeasurementState
from engine.core.geometry import Intrinsics, RigidTransform

FARTHEST_READING = 65_535


def calibration(depth_size, color_size, *, focal_share=0.9, baseline_mm=0.0):
    """Two cameras of the given sizes (width, height) [px] side by side, with a lens of some distortion."""

    def camera(size):
        width, height = size
        focal_px = focal_share * width
        return Intrinsics(
            width=width,
            height=height,
            fx=focal_px,
            fy=focal_px,
            cx=(width - 1) / 2.0,
            cy=(height - 1) / 2.0,
            distortion=(0.1, -0.2, 0.001, -0.001, 0.05) if baseline_mm else (0.0, 0.0, 0.0, 0.0, 0.0),
        )

    return Calibration(
        camera="any pictures",
        depth=camera(depth_size),
        color=camera(color_size),
        color_from_depth=RigidTransform(rotation=np.eye(3), translation_mm=np.array([baseline_mm, 0.0, 0.0])),
    )


def room_mm(rng, shape):
    """A wall or a floor seen at an angle, and boxes before it."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
    slope = rng.uniform(-4.0, 4.0, 2)
    depth = rng.uniform(500.0, 9_000.0) + slope[0] * rows + slope[1] * columns
    for _ in range(rng.integers(0, 6)):
        top, left = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        depth[top : top + rng.integers(1, shape[0]), left : left + rng.integers(1, shape[1])] = rng.uniform(300, 8_000)
    depth[rng.random(shape) < rng.uniform(0.0, 0.3)] = 0.0
    return np.clip(depth, 0, FARTHEST_READING).astype(np.uint16)


def _flat_mm(rng, shape):
    return np.full(shape, rng.integers(1, 12_000), np.uint16)


DEPTHS = {
    "room": room_mm,
    "flat": _flat_mm,
    "flat, with single readings": lambda rng, shape: (
        _flat_mm(rng, shape) * (rng.random(shape) < 0.12).astype(np.uint16)
    ),
    "very near": lambda rng, shape: rng.integers(1, 60, shape).astype(np.uint16),
    "noise": lambda rng, shape: rng.integers(0, FARTHEST_READING + 1, shape).astype(np.uint16),
    "noise near the patient": lambda rng, shape: rng.integers(700, 1_000, shape).astype(np.uint16),
    "few levels": lambda rng, shape: rng.choice(rng.integers(0, 2_000, rng.integers(1, 60)), shape).astype(np.uint16),
    "blind": lambda _rng, shape: np.zeros(shape, np.uint16),
    "saturated": lambda _rng, shape: np.full(shape, FARTHEST_READING, np.uint16),
    "at the end of the range": lambda _rng, shape: np.full(shape, 10_000, np.uint16),
}


def _checkers(rng, shape):
    side = rng.integers(1, 40)
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]] // side
    levels = rng.integers(0, 256, 2).astype(np.uint8)
    return np.repeat(levels[(rows + columns) % 2][..., None], 3, axis=2)


def _blobs(rng, shape):
    """White discs of a marker's looks and of any size, at any place; now and then four in a rectangle, or in a line."""
    picture = np.full((*shape, 3), rng.integers(0, 120), np.uint8)
    radius = rng.uniform(1.0, min(shape) / 6.0)
    height, width = shape
    match rng.integers(0, 3):
        case 0:
            centers = rng.uniform((0, 0), (width, height), (rng.integers(1, 40), 2))
        case 1:
            left, right = sorted(rng.uniform(0, width, 2))
            top, bottom = sorted(rng.uniform(0, height, 2))
            centers = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
        case _:
            centers = np.linspace(rng.uniform((0, 0), (width, height)), rng.uniform((0, 0), (width, height)), 4)
    for x, y in centers:
        cv2.circle(picture, (round(x * 16), round(y * 16)), round(radius * 16), (235,) * 3, -1, cv2.LINE_AA, shift=4)
    return picture


COLORS = {
    "black": lambda _rng, shape: np.zeros((*shape, 3), np.uint8),
    "white": lambda _rng, shape: np.full((*shape, 3), 255, np.uint8),
    "noise": lambda rng, shape: rng.integers(0, 256, (*shape, 3), np.uint8),
    "salt": lambda rng, shape: np.repeat((rng.random(shape) < 0.02)[..., None], 3, axis=2).astype(np.uint8) * 255,
    "checkers": _checkers,
    "blobs": _blobs,
}


def damage_of_depth(rng, depth_mm):
    """A depth picture with something wrong in a part of it, or in all of it."""
    damaged = depth_mm.copy()
    part = _part(rng, depth_mm.shape)
    match rng.integers(0, 8):
        case 0:
            damaged[part] = rng.choice([0, 1, 10_000, FARTHEST_READING])
        case 1:
            damaged[part] = rng.integers(0, FARTHEST_READING + 1, damaged[part].shape)
        case 2:
            damaged[rng.random(depth_mm.shape) < rng.uniform(0.0, 1.0)] = 0
        case 3:
            damaged = np.clip(damaged * rng.choice([0.02, 0.3, 0.9, 1.1, 3.0, 12.0]), 0, FARTHEST_READING)
        case 4:
            damaged[part] = np.roll(damaged[part], rng.integers(1, 40), axis=rng.integers(0, 2))
        case 5:
            damaged[part] ^= np.uint16(1 << rng.integers(0, 16))
        case 6:
            damaged = room_mm(rng, depth_mm.shape)
        case _:
            damaged[part] += np.uint16(rng.integers(0, 400))
    return damaged.astype(np.uint16)


def damage_of_color(rng, color):
    """A colour picture with something wrong in a part of it, or in all of it."""
    damaged = color.copy()
    part = _part(rng, color.shape[:2])
    match rng.integers(0, 7):
        case 0:
            damaged[part] = rng.integers(0, 256)
        case 1:
            damaged[part] = rng.integers(0, 256, damaged[part].shape)
        case 2:
            damaged = np.roll(damaged, rng.integers(-12, 13, 2), axis=(0, 1))
        case 3:
            damaged = cv2.GaussianBlur(damaged, (0, 0), rng.uniform(0.3, 6.0))
        case 4:
            damaged = cv2.resize(damaged[part], color.shape[1::-1])
        case 5:
            damaged = 255 - damaged
        case _:
            damaged = np.maximum(damaged, _blobs(rng, color.shape[:2]))
    return damaged


def damaged(rng, frame):
    """A frame with its depth, its colour or both damaged, and now and then its times."""
    which = rng.integers(0, 3)
    gap_us = int(rng.choice([0, 0, 0, 50_000, 10_000_000]))
    return replace(
        frame,
        depth_mm=frame.depth_mm if which == 0 else damage_of_depth(rng, frame.depth_mm),
        color=frame.color if which == 1 else damage_of_color(rng, frame.color),
        color_timestamp_us=frame.color_timestamp_us + gap_us,
    )


def _part(rng, shape):
    top, left = (int(rng.integers(0, size - 1)) for size in shape)
    return slice(top, int(rng.integers(top + 1, shape[0] + 1))), slice(left, int(rng.integers(left + 1, shape[1] + 1)))


def check(outcome, frame):
    """Hold a measurement against what everything behind the pipeline relies on."""
    assert (outcome.frame_index, outcome.timestamp_us) == (frame.index, frame.timestamp_us)
    assert (outcome.lost is not None) == (outcome.state is MeasurementState.LOST)
    assert (outcome.motion is not None) == (outcome.state is MeasurementState.MEASURING)
    if outcome.lost is not None:
        assert outcome.lost.detail
        assert "nan" not in outcome.lost.detail
    if outcome.markers is not None:
        assert np.isfinite(outcome.markers.centers_px).all()
    if outcome.motion is not None:
        motion, fit = outcome.motion, outcome.motion.projection
        numbers = [motion.whole_mm, motion.thorax_mm, motion.abdomen_mm, motion.volume_l, fit.residual_mm]
        assert np.isfinite(numbers).all()
        assert np.isfinite(fit.coefficients).all()
        assert np.isfinite(motion.surface_mm).all()
        assert 0.0 <= fit.valid_share <= 1.0
        assert 0.0 <= fit.inlier_share <= 1.0
