"""Bakes what a virtual Xtion plays: a volunteer who breathes regularly, in a loop without a seam, and his calibration.

Kept between runs in a folder of the machine's temporary files, by a hash of all it follows from; half a gigabyte.
"""

import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

import lab.phantom
from engine.calibration.camera_calibration import Calibration, parse_calibration
from lab.phantom.breathing import STEP_S, Breathing, Signals, breath_shape
from lab.phantom.scene import Scene, Script
from lab.phantom.sensor import depth_table_mm
from lab.phantom.studio import Studio
from tests.support.build_cache import digest_of, made_once
from tests.support.virtual_camera import block

FPS = 29.97
COLOR_LAG = 0.35
"""A colour frame comes this share of a period after its depth frame, as the phantom's recordings have it."""

FRAMES = 348
"""Three breaths of 3.9 s, and, for volunteer 1, twelve beats of his heart."""

AMPLITUDES = (1.0, 0.96, 1.05)
FRAME_BYTES = 5 * block.WIDTH_PX * block.HEIGHT_PX
_PAGE = 4096
_CHUNK = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Which volunteer, and how many frames; few are for tests that only look at pictures."""

    volunteer: int = 1
    frames: int = FRAMES
    seed: int = 1


class Film:
    """Baked frames: ``ring_path`` for the driver, and what is true of them."""

    def __init__(self, folder: Path) -> None:
        self.ring_path = folder / "frames.ring"
        self.calibration_path = folder / "calibration.json"
        self._truth_path = folder / "truth.npz"

    @cached_property
    def calibration(self) -> Calibration:
        return parse_calibration(self.calibration_path.read_bytes())

    @cached_property
    def truth(self) -> dict[str, np.ndarray]:
        """``whole_mm``, ``thorax_mm``, ``abdomen_mm`` (n,): depth; ``markers_px`` (n, 4, 2) in the colour picture."""
        with np.load(self._truth_path) as file:
            return dict(file)

    @property
    def frames(self) -> int:
        return len(self.truth["whole_mm"])

    @property
    def exhaled(self) -> int:
        """The frame in which the patient has breathed out furthest."""
        return int(np.argmax(self.truth["whole_mm"]))

    @property
    def inhaled(self) -> int:
        """The frame in which the patient has breathed in furthest."""
        return int(np.argmin(self.truth["whole_mm"]))

    def pictures(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Depth (480, 640) mm and colour (480, 640, 3) RGB of a baked frame."""
        shape = (block.HEIGHT_PX, block.WIDTH_PX)
        with self.ring_path.open("rb") as file:
            file.seek(_frames_at() + frame * FRAME_BYTES)
            raw = file.read(FRAME_BYTES)
        split = 2 * shape[0] * shape[1]
        depth = np.frombuffer(raw[:split], np.uint16).reshape(shape)
        return depth, np.frombuffer(raw[split:], np.uint8).reshape(*shape, 3)


def baked(look: Look | None = None) -> Film:
    """Return the film, baked first where it is not kept from an earlier run."""
    look = look or Look()
    with made_once(f"film-{_digest(look)}") as (folder, draft):
        if draft is not None:
            _bake(look, draft)
    return Film(folder)


def _digest(look: Look) -> str:
    return digest_of(look, Path(__file__), Path(block.__file__), Path(lab.phantom.__path__[0]))


def _studio(look: Look) -> Studio:
    seconds = look.frames / FPS
    script = Script(scenario="regular", volunteer=look.volunteer, seconds=max(seconds, 2.0), fps=FPS, seed=look.seed)
    studio = Studio(script)
    studio.scene.breathing = Breathing(_signals(studio.scene, seconds), studio.scene.anatomy.build)
    return studio


def _signals(scene: Scene, seconds: float) -> Signals:
    """Breaths that are over when the loop is, before, within and after it."""
    build = scene.anatomy.build
    time_s = np.arange(-4.0, seconds + 4.0, STEP_S)
    breaths = np.mod(time_s, seconds) / seconds * len(AMPLITUDES)
    which = np.minimum(breaths.astype(int), len(AMPLITUDES) - 1)
    shape = build.amplitude_mm * np.array(AMPLITUDES)[which] * breath_shape(breaths - which)
    return Signals(time_s=time_s, abdomen_mm=shape, thorax_mm=build.thorax_share * shape)


def _rays_bytes() -> int:
    return 12 * block.WIDTH_PX * block.HEIGHT_PX


def _frames_at() -> int:
    return -(-(2 * _PAGE + _rays_bytes()) // _PAGE) * _PAGE


def _bake(look: Look, draft: Path) -> None:
    studio = _studio(look)
    path = draft / "frames.ring"
    rig = studio.scene.rig
    head = _head(studio.scene, look)
    columns, rows = np.meshgrid(np.arange(block.WIDTH_PX, dtype=float), np.arange(block.HEIGHT_PX, dtype=float))
    rays = rig.depth.rays(np.column_stack([columns.ravel(), rows.ravel()])) @ rig.color_from_depth.rotation.T
    with path.open("wb") as file:
        file.write(bytes(head))
        file.seek(2 * _PAGE)
        file.write(np.ascontiguousarray(rays, np.float32).tobytes())
        file.truncate(_frames_at() + look.frames * FRAME_BYTES)
    chunks = [range(at, min(at + _CHUNK, look.frames)) for at in range(0, look.frames, _CHUNK)]
    if len(chunks) == 1:
        _bake_some(path, studio, chunks[0])
    else:
        context = multiprocessing.get_context("spawn")
        workers = len(os.sched_getaffinity(0))
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(look,)) as pool:
            list(pool.map(_bake_in_worker, [str(path)] * len(chunks), chunks))
    (draft / "calibration.json").write_text(rig.calibration.to_json(), encoding="utf-8")
    np.savez(draft / "truth.npz", **_truth(studio.scene, look))
    (draft / "look.json").write_text(json.dumps({"volunteer": look.volunteer, "frames": look.frames}))


def _head(scene: Scene, look: Look) -> block.RingHead:
    rig = scene.rig
    color, depth = rig.color, rig.depth
    return block.RingHead(
        magic=block.MAGIC,
        frames=look.frames,
        width=block.WIDTH_PX,
        height=block.HEIGHT_PX,
        frames_at=_frames_at(),
        rays_at=2 * _PAGE,
        color_fx=color.fx,
        color_fy=color.fy,
        color_cx=color.cx,
        color_cy=color.cy,
        distortion=(block.ctypes.c_double * 5)(*color.distortion),
        translation_mm=(block.ctypes.c_double * 3)(*rig.color_from_depth.translation_mm),
        depth_fx=depth.fx,
        depth_fy=depth.fy,
        depth_table_mm=(block.ctypes.c_uint16 * 2048)(*(int(mm) for mm in depth_table_mm())),
    )


_studios: list[Studio] = []


def _start(look: Look) -> None:
    import cv2

    cv2.setNumThreads(1)
    _studios[:] = [_studio(look)]


def _bake_in_worker(path: str, frames: range) -> None:
    _bake_some(Path(path), _studios[0], frames)


def _bake_some(path: Path, studio: Studio, frames: range) -> None:
    with path.open("r+b") as file:
        for frame in frames:
            file.seek(_frames_at() + frame * FRAME_BYTES)
            file.write(studio.depth_frame(frame, frame / FPS).astype("<u2").tobytes())
            file.write(np.ascontiguousarray(studio.color_frame(frame, (frame + COLOR_LAG) / FPS)).tobytes())


def _truth(scene: Scene, look: Look) -> dict[str, np.ndarray]:
    times_s = [frame / FPS for frame in range(look.frames)]
    halves = np.stack([scene.roi_truth(time_s).cells(scene.breathing.weights(time_s))[1] for time_s in times_s])
    markers = np.stack([scene.markers_px((frame + COLOR_LAG) / FPS) for frame in range(look.frames)])
    return {
        "whole_mm": halves.mean(axis=1),
        "thorax_mm": halves[:, 0],
        "abdomen_mm": halves[:, 1],
        "markers_px": markers,
    }
