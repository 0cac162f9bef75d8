"""Outcomes of a run with known errors."""

import numpy as np

from lab.evaluation.methods.outcome import MEASURING, TRAINING, Outcome, Track

N = 60


def breath(n=N, amplitude_mm=5.0):
    return amplitude_mm * (1.0 - np.cos(np.linspace(0.0, 8.0 * np.pi, n)))


def depth_track(motion_mm):
    """The truth: everything moves alike, at 850 mm."""
    track = Track.empty(len(motion_mm))
    track.cells_mm[:] = 850.0 - motion_mm[:, None, None]
    track.wide_mm[:] = track.points_mm[:, :3] = 850.0 - motion_mm[:, None]
    track.points_mm[:] = 850.0 - motion_mm[:, None]
    track.volume_l[:] = 0.05 * motion_mm
    return track


def measured_track(motion_mm, first, error_mm=0.0):
    """A method that begins at frame ``first`` and is off by ``error_mm`` in every frame after its reference."""
    track = Track.empty(len(motion_mm))
    off = np.broadcast_to(error_mm, motion_mm.shape).copy()
    off[first] = 0.0
    seen = slice(first, None)
    motion = (motion_mm - motion_mm[first] + off)[seen]
    track.cells_mm[seen] = motion[:, None, None]
    track.wide_mm[seen] = motion[:, None]
    track.points_mm[seen] = motion[:, None]
    track.volume_l[seen] = 0.05 * motion
    return track


def outcome(ours, plain=None, oracle=None, *, events=(), state=None):
    motion = breath()
    n = len(motion)
    tracks = {"ours": ours}
    tracks |= {name: track for name, track in (("plain", plain), ("oracle", oracle)) if track is not None}
    measured = ours.is_measured
    return Outcome(
        timestamp_us=np.arange(n, dtype=np.int64) * 100_000,
        truth=depth_track(motion),
        tracks=tracks,
        state=np.where(measured, MEASURING, TRAINING).astype(np.int8) if state is None else state,
        residual_mm=np.where(measured, 0.5, np.nan),
        valid_share=np.where(measured, 0.97, np.nan),
        is_trusted=measured.copy(),
        notes={"lost": {}},
        events=list(events),
    )
