"""Frames of a small breathing surface, and a model learned from them."""

import cv2
import numpy as np

from engine.core.frames import ROI_COLUMNS, ROI_ROWS
from engine.motion.learning.fitting import fit

ROWS, COLUMNS = np.mgrid[0:ROI_ROWS, 0:ROI_COLUMNS].astype(np.float32)

REST_MM = 850.0 + 0.001 * (COLUMNS - 100.0) ** 2

BREATH = 0.4 + 0.6 * np.exp(-(((ROWS - 250.0) / 120.0) ** 2) - ((COLUMNS - 100.0) / 110.0) ** 2)

SIGNAL_MM = 4.0 - 4.0 * np.cos(np.linspace(0.0, 8.0 * np.pi, 160))


def frames(noise_mm, stride=2, blur_px=0.0, seed=1, signal_mm=SIGNAL_MM, holes=0.0):
    """Breathing with noise of this deviation a point, correlated over ``blur_px`` points."""
    rng = np.random.default_rng(seed)
    thin = (slice(None, None, stride),) * 2
    rest, breath = REST_MM[thin], BREATH[thin]
    depth = np.empty((len(signal_mm), *rest.shape), dtype=np.float32)
    for frame, amplitude in zip(depth, signal_mm, strict=True):
        noise = rng.standard_normal(rest.shape).astype(np.float32)
        if blur_px:
            noise = cv2.GaussianBlur(noise, (0, 0), blur_px)
            noise /= noise.std()
        frame[:] = rest - amplitude * breath + noise_mm * noise
    return depth, rng.random(depth.shape) >= holes


def learn(depth, valid, components=3):
    return fit(
        np.where(valid, depth, np.float32(0.0)),
        valid,
        components=components,
        cycles=4,
        seconds=16.0,
        calibration_sha256="0" * 64,
    )
