"""Compares every frame with the reference without the motion model: the surface, its colour, and the scene beside it.

Three kinds of disagreement are distinguished. The scene has moved: that is the camera, or the couch. The surface has
changed in a way that is neither breathing nor a rigid movement, or has another colour: something lies on the patient.
The surface has moved rigidly before a scene that stands still: that is the patient, who is still measured.

A disagreement and a position stand while they cannot be measured: what is hidden has not come back. Each comparison
says whether it could be made (`Evidence`): the gate does not rest on one that could not.
"""

import math
from collections import deque
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.core.compiled import FramePath
from engine.core.frames import (
    ROI_COLUMNS,
    ROI_ROWS,
    BodyPosition,
    ColorImage,
    Evidence,
    FloatArray,
    Lost,
    LostReason,
    Markers,
    Mover,
    RgbdFrame,
    RoiDepth,
    RoomChange,
    ThinViews,
    frozen,
)
from engine.core.geometry import RigidTransform
from engine.core.sentences import say
from engine.motion.cross_check.appearance import (
    DARK,
    LEAST_DARK_CELLS,
    Brightness,
    Chroma,
    ColorChange,
    brightness_of,
    chroma_of,
    color_change,
    darkened_share,
)
from engine.motion.cross_check.cell_surface import (
    CELLS,
    LEAST_CELLS,
    BreathingShapes,
    GatheredSurfaces,
    LearnedShapes,
    StoredModes,
    SurfaceChange,
    cell_means,
    shapes_of,
)
from engine.motion.cross_check.present_noise import PresentNoise
from engine.motion.cross_check.static_scene import StaticScene

AVERAGED_US = 200_000
"""Frames of this long are averaged: a fifth of a second lowers the noise by half, and a disagreement lasts longer."""
MOST_FRAMES = 32
LEAST_MISFIT_MM = 0.25
MOST_MISFIT_MM = 0.6
MISFIT_OF_USUAL = 1.7
"""Allowed misfit of the surface: this many times that of the training, within the two bounds above."""
MISFIT_OF_DEEPER = 0.15
"""More misfit is allowed in a breath deeper than any of the training: this share of what it is deeper."""
MISFIT_OF_REDISTRIBUTED = 0.1
"""And of what is shifted between thorax and abdomen, other than in the training: this share, as one more error beside.

A breath hold shifts millimetres, a thin cover over half of the region one.
"""
HEIGHT_OF_DEEPER = 0.6
"""Such a breath also passes for a rigid movement since it began: up to this share of what it is deeper is taken off."""
OTHER_COLOR_SHARE = 0.06
LEAST_COLORED = 0.5
"""Share of the region that needs a colour, now and at the reference: in the dark an object has none."""
CAMERA_MM = 1.5
"""Allowed change of the scene's depth at a marker, as the camera's movement changes it."""
MOVERS = {False: Mover.COUCH, True: Mover.CAMERA, None: Mover.EITHER}
"""What has moved, by whether the floor has; None where couch and floor are not both seen."""
MARKER_PERCENTILE = 90.0
RETURNED = 0.8
"""A disagreement ends at this share of its limit."""
AGREEING = {"camera": 1.0, "colour": 1.0, "surface": 1.0}
"""The share of the limit of each disagreement that counts while there is none."""
_CELLS_MM, _SCENE_MM = attrgetter("cells_mm"), attrgetter("scene_mm")
MOST_SURFACES = 3000
_UNKNOWN_MM = frozen(np.full(4, np.nan))
ADVICE = say("check for objects on the patient, then set the reference again")


class _Observed(NamedTuple):
    """What is compared of one frame: ``corners_mm`` and ``scene_mm`` are NaN where unknown."""

    timestamp_us: int
    corners_mm: FloatArray
    cells_mm: FloatArray
    chroma: Chroma
    scene_mm: FloatArray


@dataclass(slots=True, kw_only=True, eq=False)
class _Reference:
    """Surface and colour at the reference; the surface is that of the frames around it, since one frame has noise.

    ``newest_chroma`` is the colour of later frames, owned and written to: a cell that is dark now keeps the colour it
    was last seen in.
    """

    surfaces_mm: list[FloatArray]
    chroma: Chroma
    set_us: int
    cells_mm: FloatArray
    newest_chroma: Chroma
    brightness: Brightness

    def add(self, cells_mm: FloatArray, timestamp_us: int) -> None:
        """Take the surface of a later frame, if it is close enough to the reference in time."""
        if 0 < timestamp_us - self.set_us <= AVERAGED_US:
            self.surfaces_mm.append(cells_mm)
            self.cells_mm = _mean_seen(self.surfaces_mm)


class CrossCheck:
    """Follows surface, colour and scene; owned by the pipeline's thread.

    ``shapes`` are the shapes of breathing learned with the model in use, if any; ``doubt`` is that the camera or the
    couch has moved since the reference, None where neither has.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._depth_from_color = calibration.color_from_depth.inverse
        self._scene = StaticScene(calibration.depth)
        self._recent: deque[_Observed] = deque(maxlen=MOST_FRAMES)
        self._gathered_mm = np.empty((MOST_SURFACES, CELLS))
        self._gathered = self._gathered_total = 0
        self.shapes: BreathingShapes | None = None
        self._model: StoredModes | None = None
        self._reference: _Reference | None = None
        self._disagreements: dict[str, Lost] = {}
        self._tightened = dict(AGREEING)
        self.doubt: Lost | None = None
        self._settled_mm = 0.0
        self._newest_color: tuple[ColorImage, FloatArray] | None = None
        self.position: BodyPosition | None = None
        self.evidence: Evidence | None = None
        self.noise = PresentNoise(math.sqrt(ROI_ROWS * ROI_COLUMNS / CELLS))

    def restart(self) -> None:
        """Forget the reference: camera or patient may have moved."""
        self._recent.clear()
        self._reference = None
        self._forget_changes()

    def _forget_changes(self) -> None:
        self._disagreements, self._tightened = {}, dict(AGREEING)
        self._settled_mm, self.position, self.evidence, self.doubt = 0.0, None, None, None
        self._scene.restart()
        for number, one in enumerate(self._recent):
            self._recent[number] = one._replace(scene_mm=_UNKNOWN_MM)  # against the scene of before

    def use(self, learned: tuple[StoredModes | None, BreathingShapes | None]) -> None:
        """Use what an earlier pass over the same recording has learned."""
        self._model, self.shapes = learned

    def gather(self) -> None:
        """Keep the surface of the newest frame, which the model is learned from, to learn the shapes of breathing."""
        if self._recent:
            self._gathered_mm[self._gathered % MOST_SURFACES] = self._recent[-1].cells_mm
            self._gathered += 1
            self._gathered_total += 1

    @property
    def gathered(self) -> GatheredSurfaces | None:
        """What was gathered for the next model; None without anything.

        A training job learns the shapes from it, as that takes milliseconds. Of what is gathered after that, `lost`
        learns them itself.
        """
        if self._gathered == 0:
            return None
        oldest = max(self._gathered - MOST_SURFACES, 0)
        places = np.arange(oldest, self._gathered) % MOST_SURFACES
        return GatheredSurfaces(self._gathered_total, self._gathered_mm[places])

    def observe(
        self, frame: RgbdFrame, views: ThinViews, found: Markers, marker_rays: FloatArray, roi: RoiDepth
    ) -> None:
        """Take what is compared of a frame whose markers were found, on these rays, shape (4, 3)."""
        recent, now_us = self._recent, frame.timestamp_us
        while recent and not 0 <= now_us - recent[0].timestamp_us <= AVERAGED_US:
            recent.popleft()
        cells_mm = cell_means(roi)
        corners_mm, in_depth_camera = _marker_places_mm(cells_mm, marker_rays, self._depth_from_color)
        scene_mm = None
        if in_depth_camera is not None:
            scene_mm = self._scene.follow(views.depth_mm, in_depth_camera, now_us)
        self._newest_color = (frame.color, found.centers_px)
        self.noise.add(cells_mm, now_us)
        recent.append(
            _Observed(
                timestamp_us=now_us,
                corners_mm=corners_mm,
                cells_mm=cells_mm,
                chroma=chroma_of(frame.color, found.centers_px, views.color),
                scene_mm=_UNKNOWN_MM if scene_mm is None else scene_mm,
            )
        )

    def lost(self, model: StoredModes, *, is_reference_due: bool, learned: object = None) -> Lost | None:
        """Return the loss if surface or colour disagree with the reference; the first frame of a reference agrees.

        ``learned`` are the `LearnedShapes` of the job that fitted the model, if any.
        """
        if model is not self._model:
            self._learn_shapes(model, learned if isinstance(learned, LearnedShapes) else None)
        cells_mm = _mean(list(map(_CELLS_MM, self._recent)))
        chroma = self._recent[-1].chroma
        newest = self._recent[-1]
        if is_reference_due or self._reference is None:
            surfaces_mm = [one.cells_mm for one in self._recent]
            self._reference = _Reference(
                surfaces_mm=surfaces_mm,
                chroma=chroma,
                set_us=newest.timestamp_us,
                cells_mm=_mean_seen(surfaces_mm),
                newest_chroma=chroma.copy(),
                brightness=self._brightness(),
            )
            self._forget_changes()
        return self._compare(self._reference, cells_mm, chroma)

    def _learn_shapes(self, model: StoredModes, ahead: LearnedShapes | None) -> None:
        """Learn the shapes of breathing from what was gathered; a refit, for which nothing was, changes none."""
        gathered = self.gathered
        if gathered is not None or self.shapes is None:
            if ahead is None or ahead.total != self._gathered_total:
                ahead = None if gathered is None else gathered.learn()
            self.shapes = (None if ahead is None else ahead.shapes) or shapes_of(model)
        self._model = model
        self._gathered = 0

    def confirm(self) -> None:
        """Average the newest frame into a reference that was just set; call it for measured frames only."""
        if self._reference is not None and self._recent:
            self._reference.add(self._recent[-1].cells_mm, self._recent[-1].timestamp_us)

    def _compare(self, reference: _Reference, cells_mm: FloatArray, chroma: Chroma) -> Lost | None:
        moved_mm = _largest_mean_mm(list(map(_SCENE_MM, self._recent)))
        change = self._surface_change(reference, cells_mm)
        color = color_change(reference.chroma, chroma, reference.newest_chroma)
        self.evidence = Evidence(
            surface=change is not None,
            color=color.colored_share >= LEAST_COLORED,
            camera=not math.isnan(moved_mm),
            colored_share=color.colored_share,
        )
        found = {
            "camera": self._camera_moved(moved_mm),
            "colour": self._color_changed(self._changed_share(reference, chroma, color)),
            "surface": self._surface_changed(change),
        }
        self._disagreements = {}
        for name, lost in found.items():
            self._tightened[name] = 1.0 if lost is None else RETURNED
            if lost is not None:
                self._disagreements[name] = lost
        self.doubt = found["camera"]
        return self._disagreements.get("colour") or self._disagreements.get("surface")

    def _camera_moved(self, moved_mm: float) -> Lost | None:
        if math.isnan(moved_mm):
            return self.doubt
        if moved_mm <= self._tightened["camera"] * CAMERA_MM:
            return None
        mover = MOVERS[self._scene.has_floor_moved]
        if mover is Mover.COUCH:
            detail = say(
                "the couch is {moved_mm:.1f} mm from where it was at the reference, the floor has not moved: "
                "the couch has moved",
                moved_mm=moved_mm,
            )
        else:
            what = say("camera or couch has moved") if mover is Mover.EITHER else say("the camera has moved")
            detail = say(
                "couch and floor are {moved_mm:.1f} mm from where they were at the reference: {what}",
                moved_mm=moved_mm,
                what=what,
            )
        detail = say("{detail}, set the reference again", detail=detail)
        return Lost(reason=LostReason.CAMERA_MOVED, detail=detail, moved=RoomChange(mover, moved_mm))

    def _brightness(self) -> Brightness:
        """Return the brightness of the newest frame's picture."""
        if self._newest_color is None:
            return DARK
        return brightness_of(*self._newest_color)

    def _changed_share(self, reference: _Reference, chroma: Chroma, color: ColorChange) -> float:
        """Return the share of the region with another colour, or darkened while its surroundings are not."""
        if color.dark_cells <= LEAST_DARK_CELLS:
            return color.changed_share
        darkened = darkened_share(reference.chroma, chroma, reference.brightness, self._brightness())
        return max(color.changed_share, darkened)

    def _color_changed(self, share: float) -> Lost | None:
        if not share > self._tightened["colour"] * OTHER_COLOR_SHARE:
            return None
        detail = say(
            "{share:.0%} of the region has another colour than at the reference, or is dark: {advice}",
            share=share,
            advice=ADVICE,
        )
        return Lost(reason=LostReason.SURFACE_CHANGED, detail=detail)

    def _surface_change(self, reference: _Reference, cells_mm: FloatArray) -> SurfaceChange | None:
        """Return how the surface has changed since the reference; None where too little of it is seen."""
        is_seen = np.add.reduce(np.isfinite(self._recent[-1].cells_mm)) >= LEAST_CELLS
        return self.shapes.change(reference.cells_mm, cells_mm) if self.shapes is not None and is_seen else None

    def _surface_changed(self, change: SurfaceChange | None) -> Lost | None:
        """Compare the surface's change with breathing and a rigid movement, which becomes the patient's position."""
        shapes = self.shapes
        if shapes is None or change is None:
            return self._disagreements.get("surface")
        deeper_mm = max(change.breath_mm - shapes.reach_mm, 0.0)
        self.position = self._position(change, deeper_mm)
        usual_mm = shapes.misfit_mm * self._less_noise()
        allowed_mm = min(max(MISFIT_OF_USUAL * usual_mm, LEAST_MISFIT_MM), MOST_MISFIT_MM)
        allowed_mm = math.hypot(allowed_mm, MISFIT_OF_REDISTRIBUTED * change.redistributed_mm)
        if "surface" not in self._disagreements:
            allowed_mm += MISFIT_OF_DEEPER * deeper_mm
        if not change.spread_mm > self._tightened["surface"] * allowed_mm:
            return None
        largest_mm = float(np.nanmax(np.abs(change.misfit_mm)))
        detail = say(
            "the surface differs by up to {largest_mm:.1f} mm from breathing and "
            "from a patient who moved as a whole ({spread_mm:.2f} mm on average, {allowed_mm:.2f} allowed): {advice}",
            largest_mm=largest_mm,
            spread_mm=change.spread_mm,
            allowed_mm=allowed_mm,
            advice=ADVICE,
        )
        return Lost(reason=LostReason.SURFACE_CHANGED, detail=detail)

    def _less_noise(self) -> float:
        """Return the share of the training's noise that there is now, 1 at most: its misfit was that of more noise."""
        share = math.nan if self._model is None else self.noise.share_of(self._model.noise_mm)
        return share if share < 1.0 else 1.0

    def _position(self, change: SurfaceChange, deeper_mm: float) -> BodyPosition:
        """Return the rigid part of a change; within a deeper breath only what such a breath does not explain."""
        since_mm = change.height_mm - self._settled_mm
        unexplained_mm = math.copysign(max(abs(since_mm) - HEIGHT_OF_DEEPER * deeper_mm, 0.0), since_mm)
        height_mm = self._settled_mm + unexplained_mm
        if deeper_mm == 0.0:
            self._settled_mm = height_mm
        length_mm, width_mm = _length_and_width_mm(self._recent[-1].corners_mm)
        return BodyPosition(
            measured_us=self._recent[-1].timestamp_us,
            height_mm=height_mm,
            tilt_deg=math.degrees(math.atan2(2.0 * change.along_mm, length_mm)),
            roll_deg=math.degrees(math.atan2(2.0 * change.across_mm, width_mm)),
            redistributed_mm=change.redistributed_mm,
        )


def _marker_places_mm(
    cells_mm: FloatArray, rays: FloatArray, depth_from_color: RigidTransform
) -> tuple[FloatArray, FloatArray | None]:
    """Return the markers' places on their rays [mm], and in the depth camera's frame; NaN and None where unknown.

    They are taken to be about as far away as the deepest of them, by the cells.
    """
    compiled = FramePath.kernels
    if compiled is None:
        places_mm = rays * _percentile(cells_mm[np.isfinite(cells_mm)], MARKER_PERCENTILE)
        return places_mm, depth_from_color.apply(places_mm) if np.isfinite(places_mm).all() else None
    places_mm, in_depth_camera = np.empty((2, *rays.shape))
    are_known = compiled.marker_places(
        cells_mm,
        MARKER_PERCENTILE,
        rays,
        depth_from_color.rotation,
        depth_from_color.translation_mm,
        places_mm,
        in_depth_camera,
    )
    return places_mm, in_depth_camera if are_known else None


def _percentile(values: FloatArray, percentile: float) -> float:
    """Return a percentile, linearly between two values; NaN of none."""
    ordered: list[float] = np.sort(values).tolist()
    if not ordered:
        return math.nan
    at = percentile / 100.0 * (len(ordered) - 1)
    before, share = int(at), at - int(at)
    below, above = ordered[before], ordered[min(before + 1, len(ordered) - 1)]
    return below + share * (above - below)


def _length_and_width_mm(corners_mm: FloatArray) -> tuple[float, float]:
    """Return the mean distances along and across the body between the corners of the region [mm], shape (4, 3)."""
    superior_right, superior_left, inferior_left, inferior_right = corners_mm.tolist()
    along, across = [], []
    for sr, sl, il, ir in zip(superior_right, superior_left, inferior_left, inferior_right, strict=True):
        along.append(il + ir - sl - sr)
        across.append(sl + il - sr - ir)
    return math.hypot(*along) / 2.0, math.hypot(*across) / 2.0


def _mean_seen(surfaces_mm: list[FloatArray]) -> FloatArray:
    """Return the mean of each cell over the frames that saw it, NaN where none did."""
    stacked = np.array(surfaces_mm)
    is_seen = np.isfinite(stacked)
    count = is_seen.sum(axis=0)
    sums = np.where(is_seen, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, sums / np.maximum(count, 1), np.nan)


def _largest_mean_mm(changes_mm: list[FloatArray]) -> float:
    """Return the largest mean of any marker's changes, shapes (4,), over the frames that saw it; NaN where none did."""
    compiled = FramePath.kernels
    if compiled is not None:
        mean_mm: float = compiled.largest_mean(changes_mm)
        return mean_mm
    largest_mm = 0.0
    for of_marker in zip(*(one.tolist() for one in changes_mm), strict=True):
        seen_mm = [change_mm for change_mm in of_marker if math.isfinite(change_mm)]
        if not seen_mm:
            return math.nan
        largest_mm = max(largest_mm, abs(sum(seen_mm) / len(seen_mm)))
    return largest_mm


def _mean(values: list[FloatArray]) -> FloatArray:
    """Return the mean of each cell over the frames that saw it; NaN where fewer than half of them did."""
    compiled = FramePath.kernels
    if compiled is not None:
        mean = np.empty(len(values[0]))
        compiled.mean_cells(values, mean)
        return mean
    stacked = np.array(values)
    is_seen = np.isfinite(stacked)
    count = is_seen.sum(axis=0)
    sums = np.where(is_seen, stacked, 0.0).sum(axis=0)
    return np.where(2 * count >= len(values), sums / np.maximum(count, 1), np.nan)
