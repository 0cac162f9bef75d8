"""Makes a virtual volunteer's folder: ``recording.oni``, ``calibration.json``, ``truth.npz`` and ``flow.csv``.

With a laser also ``plane.json``, its plane.

The same arguments give the same bytes on the same processor with the same number of processes; otherwise single
readings may round to the sensor's next step. The files appear together at the end; a failed or cancelled call leaves
none.
"""

import json
import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.laser_plane import LaserPlane
from engine.capture.oni.codec import encode_16zt, encode_jpeg
from engine.capture.oni.writer import OniWriter
from engine.core.bounds import check_number, check_whole_number
from engine.core.errors import InvalidValueError, RecordingError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray
from engine.qa.recorded_traces import Trace, read_trace
from lab.phantom.builds import NO_DEPARTURE, Departure, find_build
from lab.phantom.falsifications import Falsification
from lab.phantom.laser import CostalStickers, Flow, LaserTruth, breathe_through, hang_laser, truth_columns
from lab.phantom.scenarios import check_scenario
from lab.phantom.scene import Scene, Script
from lab.phantom.sensor import USUAL, find_sensor
from lab.phantom.studio import Studio
from lab.phantom.truth import POINTS_RC, Grid, Truth, load_truth, roi_nodes

__all__ = ["Truth", "load_truth", "make_volunteer"]

FILES = ("recording.oni", "calibration.json", "truth.npz", "flow.csv")
LASER_FILE = "plane.json"
SLOWEST_FPS, FASTEST_FPS = 5.0, 60.0
TRUE_RATE = 0.999
# The colour clock runs slow against the depth clock, and starts later.
COLOR_PERIOD = 1.0007
JITTER_US = 180.0
JPEG_QUALITY = 90
FULL_GRIDS = 5
_CHUNK = 24
_LEAST_FRAMES_A_WORKER = 60

Stamps = npt.NDArray[np.int64]
_WORKER: list[Studio] = []


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Chunk:
    """Encoded frames of both streams and their truth, made by one process."""

    depth_payloads: list[bytes]
    color_payloads: list[bytes]
    cells_mm: Grid
    halves_mm: Grid
    points_mm: Grid
    depth_markers_px: Grid
    markers_px: Grid
    full_mm: Grid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Task:
    """Frames to make: numbers and times of both streams."""

    depth: range
    color: range
    depth_us: Stamps
    color_us: Stamps
    full: list[int]


def make_volunteer(
    scenario: str,
    *,
    volunteer: int,
    seconds: float,
    fps: float = 30.0,
    seed: int,
    out: Path,
    trace: Path | None = None,
    departure: Departure = NO_DEPARTURE,
    has_laser: bool = False,
    has_extra_markers: bool = False,
    sensor: str = USUAL,
    falsification: Falsification | None = None,
    workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> None:
    """Make a volunteer's recording, calibration and truth in the folder ``out``.

    Parameters
    ----------
    scenario
        regular, irregular, isovolume, dibh, drift, shift or occlusion.
    volunteer
        1 to 10.
    seconds, fps
        Length and nominal rate; the true rate is a thousandth lower, as the sensor's is.
    seed
        0 to 2^32 - 1.
    trace
        Recorded breathing to follow instead: a marker CSV, an RPM ``.vxp`` or a QA text.
    departure
        Changes of the volunteer's parameters: camera height, amplitude, holes.
    has_laser
        Add a laser line across the abdomen, and write its plane.
    has_extra_markers
        Add two stickers at the costal margin; the truth's labels then hold ``split_rows``.
    sensor
        Name of the sensor model: usual or locking.
    falsification
        What is false about the scene from some time on, if anything; the truth stays that of the patient.
    workers
        Number of processes; one per processor by default, 1 for this process alone.
    on_progress
        Called with (depth frames made, depth frames in all).

    Raises
    ------
    InvalidValueError
        An argument is out of bounds; names field, value and bound.
    RecordingError
        The trace cannot be read, or a process was killed.
    """
    _check(volunteer=volunteer, seconds=seconds, fps=fps, seed=seed, workers=workers)
    find_sensor(sensor)
    breathing = None if trace is None else read_trace(trace)
    check_scenario(scenario, seconds, breathing)
    if out.exists() and not out.is_dir():
        raise InvalidValueError("out", str(out), "a folder")
    script = Script(
        scenario=scenario,
        volunteer=volunteer,
        seconds=float(seconds),
        fps=float(fps),
        seed=seed,
        trace=breathing,
        departure=departure,
        has_laser=has_laser,
        has_extra_markers=has_extra_markers,
        sensor=sensor,
        falsification=falsification,
    )
    with _folder(out.resolve()) as draft:
        try:
            _record(script, draft, workers, on_progress or (lambda _done, _all: None))
        except BrokenProcessPool as error:
            raise RecordingError("a process that made frames was killed; is there memory enough?") from error


def _check(*, volunteer: int, seconds: float, fps: float, seed: int, workers: int | None) -> None:
    find_build(volunteer)
    check_number("seconds", seconds, 0.0, 86_400.0)
    check_number("fps", fps, SLOWEST_FPS, FASTEST_FPS)
    check_whole_number("seed", seed, 0, 2**32 - 1)
    check_whole_number("workers", 1 if workers is None else workers, 1, 64)


@contextmanager
def _folder(out: Path) -> Iterator[Path]:
    """Yield a draft folder; on success rename it to ``out`` or move its files there, on failure remove it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    draft = out.parent / f".{out.name}-{os.getpid()}"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir()
    try:
        yield draft
        if out.exists():
            (out / LASER_FILE).unlink(missing_ok=True)  # of another recording
            for path in sorted(draft.iterdir()):
                path.replace(out / path.name)
        else:
            draft.rename(out)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _record(script: Script, draft: Path, workers: int | None, on_progress: Callable[[int, int], None]) -> None:
    depth_us, color_us = _timestamps(script)
    tasks = list(_cut(depth_us, color_us))
    chunks: list[_Chunk] = []
    done = 0
    with OniWriter(draft / FILES[0], fps=script.fps, jpeg_quality=JPEG_QUALITY) as writer:
        for task, chunk in zip(tasks, _make_all(script, tasks, workers), strict=True):
            _write_frames(writer, task, chunk)
            done += len(task.depth)
            chunks.append(replace(chunk, depth_payloads=[], color_payloads=[]))
            on_progress(done, len(depth_us))
    scene = Scene(script)
    if script.has_laser:
        (draft / LASER_FILE).write_text(_plane(scene).to_json(), encoding="utf-8")
    flow = breathe_through(scene, int(depth_us[0]))
    (draft / FILES[3]).write_text(flow.to_csv(), encoding="utf-8")
    (draft / FILES[1]).write_text(scene.rig.calibration.to_json(), encoding="utf-8")
    _gather_truth(scene, chunks, depth_us, color_us, flow).save(draft / FILES[2])


def _timestamps(script: Script) -> tuple[Stamps, Stamps]:
    """Generate the time stamps of both streams [us]: separate clocks and jitter, strictly increasing."""
    period_us = 1e6 / (script.fps * TRUE_RATE)
    stamps = []
    for stream, stretch, start_us in ((11, 1.0, 21_000.0), (12, COLOR_PERIOD, 21_000.0 + 0.35 * period_us)):
        count = int((script.seconds * 1e6 - start_us) / (period_us * stretch)) + 1
        jitter = np.clip(script.rng(stream).normal(0.0, JITTER_US, count), -900.0, 900.0)
        stamps.append(np.rint(start_us + period_us * stretch * np.arange(count) + jitter).astype(np.int64))
    return stamps[0], stamps[1]


def _cut(depth_us: Stamps, color_us: Stamps) -> Iterator[_Task]:
    """Cut both streams at the same times, so that each chunk can be written before the next."""
    color_from = 0
    full = _full_index(len(depth_us))
    for start in range(0, len(depth_us), _CHUNK):
        end = min(start + _CHUNK, len(depth_us))
        color_to = len(color_us) if end == len(depth_us) else int(np.searchsorted(color_us, depth_us[end]))
        yield _Task(
            depth=range(start, end),
            color=range(color_from, color_to),
            depth_us=depth_us[start:end],
            color_us=color_us[color_from:color_to],
            full=[int(index) for index in full if start <= index < end],
        )
        color_from = color_to


def _make_all(script: Script, tasks: list[_Task], workers: int | None) -> Iterator[_Chunk]:
    frames = sum(len(task.depth) for task in tasks)
    wanted = workers if workers is not None else min(len(os.sched_getaffinity(0)), frames // _LEAST_FRAMES_A_WORKER)
    if wanted <= 1:
        studio = Studio(script)
        yield from (_make(studio, task) for task in tasks)
        return
    # Fresh processes: a fork would copy the locks of the caller's threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(wanted, mp_context=context, initializer=_start_worker, initargs=(script,)) as pool:
        waiting: list[Future[_Chunk]] = []
        try:
            for task in tasks:
                waiting.append(pool.submit(_make_in_worker, task))
                # Stay only a few chunks ahead of the writer, to limit memory.
                if len(waiting) > 2 * wanted:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()


def _start_worker(script: Script) -> None:
    cv2.setNumThreads(1)
    _WORKER[:] = [Studio(script)]


def _make_in_worker(task: _Task) -> _Chunk:
    return _make(_WORKER[0], task)


def _make(studio: Studio, task: _Task) -> _Chunk:
    depth_payloads, color_payloads = [], []
    for frame, time_us in zip(task.depth, task.depth_us, strict=True):
        depth_payloads.append(encode_16zt(studio.depth_frame(frame, _seconds(time_us))))
    for frame, time_us in zip(task.color, task.color_us, strict=True):
        color_payloads.append(encode_jpeg(studio.color_frame(frame, _seconds(time_us)), JPEG_QUALITY))
    scene = studio.scene
    times_s = [_seconds(time_us) for time_us in task.depth_us]
    truths = [scene.roi_truth(time_s).cells(scene.breathing.weights(time_s)) for time_s in times_s]
    markers = [scene.markers_px(_seconds(time_us)) for time_us in task.color_us]
    full = [_full_grid(scene, times_s[index - task.depth.start]) for index in task.full]
    return _Chunk(
        depth_payloads=depth_payloads,
        color_payloads=color_payloads,
        cells_mm=np.stack([truth[0] for truth in truths]),
        halves_mm=np.stack([truth[1] for truth in truths]),
        points_mm=np.stack([truth[2] for truth in truths]),
        depth_markers_px=np.stack([scene.markers_px(time_s) for time_s in times_s]),
        markers_px=np.array(markers).reshape(-1, 4, 2),
        full_mm=np.array(full).reshape(-1, ROI_ROWS, ROI_COLUMNS),
    )


def _seconds(time_us: np.int64) -> float:
    return float(time_us) * 1e-6


def _write_frames(writer: OniWriter, task: _Task, chunk: _Chunk) -> None:
    """Write the frames of both streams in order of time."""
    frames = [(int(time), 0, payload) for time, payload in zip(task.depth_us, chunk.depth_payloads, strict=True)]
    frames += [(int(time), 1, payload) for time, payload in zip(task.color_us, chunk.color_payloads, strict=True)]
    for time_us, stream, payload in sorted(frames, key=lambda frame: frame[:2]):
        (writer.write_color_payload if stream else writer.write_depth_payload)(time_us, payload)


def _plane(scene: Scene) -> LaserPlane:
    return hang_laser(scene.anatomy, scene.rig, scene.script.volunteer)


def _gather_truth(scene: Scene, chunks: list[_Chunk], depth_us: Stamps, color_us: Stamps, flow: Flow) -> Truth:
    halves = np.concatenate([chunk.halves_mm for chunk in chunks])
    volume = scene.skin.volume_l(scene.breathing.weights(depth_us * 1e-6))
    signals = scene.timeline.signals
    return Truth(
        timestamp_us=depth_us,
        color_timestamp_us=color_us,
        cell_depth_mm=np.concatenate([chunk.cells_mm for chunk in chunks]),
        whole_depth_mm=halves.mean(axis=1),
        thorax_depth_mm=halves[:, 0],
        abdomen_depth_mm=halves[:, 1],
        point_rc=POINTS_RC,
        point_depth_mm=np.concatenate([chunk.points_mm for chunk in chunks]),
        full_index=_full_index(len(depth_us)),
        full_depth_mm=np.concatenate([chunk.full_mm for chunk in chunks]).astype(np.float32),
        volume_l=volume - volume[0],
        markers_px=np.concatenate([chunk.markers_px for chunk in chunks]),
        depth_markers_px=np.concatenate([chunk.depth_markers_px for chunk in chunks]),
        trace_s=signals.time_s,
        trace_mm=np.column_stack([signals.abdomen_mm, signals.thorax_mm]),
        labels=_labels(scene),
        spirometer_lag_s=np.array(flow.lag_s),
        **_laser_truth(scene, color_us),
    )


def _laser_truth(scene: Scene, color_us: Stamps) -> dict[str, FloatArray]:
    if not scene.script.has_laser:
        return {}
    columns_px = truth_columns(scene.markers_px(0.0))
    solver = LaserTruth(_plane(scene), scene.rig, scene.color_rays, scene.skin, columns_px)
    times_s = [_seconds(time_us) for time_us in color_us]
    lines = [solver.line(scene.breathing.weights(time_s), scene.timeline.pose(time_s)) for time_s in times_s]
    return {
        "laser_column_px": columns_px,
        "laser_row_px": np.stack([line.row_px for line in lines]),
        "laser_depth_mm": np.stack([line.depth_mm for line in lines]),
    }


def _full_index(frames: int) -> Stamps:
    return np.unique(np.linspace(0, frames - 1, FULL_GRIDS).astype(np.int64))


def _full_grid(scene: Scene, time_s: float) -> Grid:
    depth = scene.roi_truth(time_s).depth(roi_nodes(), scene.breathing.weights(time_s))
    return depth.reshape(ROI_ROWS, ROI_COLUMNS)


def _labels(scene: Scene) -> str:
    events = []
    for event in scene.timeline.events:
        values = asdict(event)
        events.append(
            {
                "name": values["name"],
                "start_us": round(event.start_s * 1e6),
                "end_us": round(event.end_s * 1e6),
                "detail": {key: float(value) for key, value in values["detail"].items()},
            }
        )
    script = scene.script
    head: dict[str, object] = {"scenario": script.scenario, "volunteer": script.volunteer, "seed": script.seed}
    trace: Trace | None = script.trace
    head |= script.departure.labels
    if script.sensor != USUAL:
        head |= {"sensor": script.sensor}
    if trace is not None:
        head |= {"trace_kind": trace.kind, "trace_axis": trace.axis}
    if script.has_extra_markers:
        head["split_rows"] = CostalStickers(scene.anatomy).split_rows(scene.rig, scene.skin, scene.timeline.pose(0.0))
    return json.dumps({**head, "events": events}, sort_keys=True)
