"""The first reference of a fraction, and how far later ones lie from it (ADR 0026).

References are compared as surfaces in the depth camera's frame: that needs no common motion model, so it works over
retrainings, stored models and a restart of the engine in the same fraction.

Levels and breathing range during training, the range being the scale of windows in per cent.

Computed from the model alone, so that a stored model has the same range: the coefficients of its training frames give
the depth of every region, and the present reference converts it to motion. The 5th percentile, the end of exhale, is
0 %; the 95th is 100 %.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from hashlib import sha256
from json import dumps
from typing import NamedTuple

import cv2
import numpy as np

from engine.core.breath import GateSignal, SignalChoice
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, FloatArray, frozen
from engine.core.position_check import PositionCheck
from engine.core.reference import FirstReference, ReferenceDistance, ReferenceMoment, SignalLevel
from engine.core.sentences import say
from engine.core.signals import LearnedLevels, Ranges, ranges_of
from engine.motion.learning.position_fit import MARKER_PLACEMENT_MM, RigidFit, position_between, rigid_between
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_transfer import ReferenceTransfer
from engine.motion.stages.regions import RegionLayout
from engine.motion.stages.surface import grid_triangles, vertices_mm, volume_l

MIN_SEEN_SHARE = 0.5
LEAST_SEEN = 0.9
"""Least share of the surface's nodes that both references need."""
AWAY = say("the camera was disconnected since")
COLD = say("it was measured while the camera was cold")
OTHER_CAMERA = say("it was measured with another calibration")
OTHER_REGIONS = say("it was measured with other regions")
NOT_MEASURED = say("the patient is not measured at present")
TOO_LITTLE = say("too little of the surface is known")
NO_MOMENT = say("the plan's position does not name the moment of the breath that it was set at")
NO_OVERLAP = say("too little of both surfaces is known, or they do not overlap")
_TRIANGLES = grid_triangles(NODE_ROWS, NODE_COLUMNS)


def learned_levels(active: PreparedModel, reference: Reference, choices: Iterable[SignalChoice]) -> LearnedLevels:
    """Return each signal's levels in the training relative to the reference; signals without levels are left out."""
    scores = active.model.scores_mm
    if scores is None or len(scores) < 2:
        return {}
    coefficients = np.zeros((len(scores), len(active.node_modes)))
    coefficients[:, : scores.shape[1]] = scores
    found = {choice: _signal(choice, active, reference, coefficients) for choice in choices}
    return {choice: levels for choice, levels in found.items() if np.isfinite(levels).all()}


def learned_ranges(active: PreparedModel, reference: Reference, choices: Iterable[SignalChoice]) -> Ranges:
    """Return the range of each signal relative to the reference [mm or l]; signals without a range are left out."""
    return ranges_of(learned_levels(active, reference, choices))


def _signal(choice: SignalChoice, active: PreparedModel, reference: Reference, coefficients: FloatArray) -> FloatArray:
    if choice.is_volume:
        return _volumes_l(active, reference, coefficients)
    position = position_of(choice, active)
    if position is None or not active.regions.is_known[position]:
        return np.full(len(coefficients), np.nan)
    depth_mm = active.regions.mean_mm[position] + coefficients @ active.regions.modes[position]
    return np.asarray(reference.regions_mm[position] - depth_mm)


def _volumes_l(active: PreparedModel, reference: Reference, coefficients: FloatArray) -> FloatArray:
    rays = None if active.model.surface_mm is None else _rays(active.model.surface_mm)
    if rays is None:
        return np.full(len(coefficients), np.nan)
    return np.array([reference.volume_above_l(vertices_mm(rays, active.node_depth_mm(one))) for one in coefficients])


def _rays(surface_mm: FloatArray) -> FloatArray | None:
    """Return the depth camera's rays (x/z, y/z) at the nodes, shape (nodes, 2); missing ones are interpolated."""
    rows, columns = np.divmod(np.arange(len(surface_mm)), NODE_COLUMNS)
    is_seen = np.asarray(np.isfinite(surface_mm).all(axis=1))
    if is_seen.sum() < MIN_SEEN_SHARE * len(surface_mm):
        return None
    rays = surface_mm[:, :2] / surface_mm[:, 2:]
    place = np.column_stack([np.ones(len(rows)), rows, columns, rows * columns])
    plane, *_ = np.linalg.lstsq(place[is_seen], rays[is_seen], rcond=None)
    return np.where(is_seen[:, None], rays, place @ plane)


def position_of(choice: SignalChoice, active: PreparedModel) -> int | None:
    """Index of a signal among the regions' means; None if there is no such cell, point or region."""
    regions = active.regions
    match choice.signal:
        case GateSignal.REGION:
            row, column = choice.row or 0, choice.column or 0
            return row * regions.columns + column if row < regions.rows and column < regions.columns else None
        case GateSignal.POINT:
            return regions.ends[1] + choice.index if choice.index < len(regions.layout.points) else None
        case GateSignal.NAMED:
            return regions.ends[2] + choice.index if choice.index < len(regions.layout.named) else None
    return regions.cells + (GateSignal.WHOLE, GateSignal.THORAX, GateSignal.ABDOMEN).index(GateSignal(choice.signal))


class Confirmed(NamedTuple):
    """A reference that was taken up: its distance from the first, and the first if this is it."""

    distance: ReferenceDistance
    first: FirstReference | None


def layout_sha256(layout: RegionLayout) -> str:
    """Return the identity of a region layout: only under the same one are regions compared by their number."""
    return sha256(dumps(asdict(layout), sort_keys=True).encode()).hexdigest()


class ReferenceHistory:
    """Keeps the first reference; owned by the pipeline's thread.

    Parameters
    ----------
    choices
        The gated signals, whose levels are part of the distance.
    marker_placement_mm
        How exactly the markers are put back in another fraction, standard deviation [mm].
    """

    def __init__(
        self,
        *,
        calibration_sha256: str,
        layout: RegionLayout,
        choices: Sequence[SignalChoice],
        marker_placement_mm: float = MARKER_PLACEMENT_MM,
    ) -> None:
        self._calibration_sha256, self._layout_sha256 = calibration_sha256, layout_sha256(layout)
        self._choices = tuple(choices)
        self._marker_placement_mm = marker_placement_mm
        self._first: FirstReference | None = None
        self._plan: FirstReference | None = None
        self._unknown = ""
        self._is_camera_lost = False
        self._is_first_ours = False

    def restore(self, first: FirstReference) -> None:
        """Continue a fraction whose first reference was confirmed in an earlier session."""
        self._first = first
        if first.calibration_sha256 != self._calibration_sha256:
            self._unknown = OTHER_CAMERA
        elif first.layout_sha256 != self._layout_sha256:
            self._unknown = OTHER_REGIONS

    def restore_plan(self, plan: FirstReference) -> None:
        """Compare the patient's position with that of the plan, of another fraction."""
        self._plan = plan

    @property
    def has_plan(self) -> bool:
        """Whether another fraction of the plan has a position."""
        return self._plan is not None

    def position(self, reference: Reference | None, moment: ReferenceMoment) -> PositionCheck | None:
        """Return where a reference of this moment lies against the plan's position; None where there is none.

        The plan's is the first reference of its first fraction. Retrainings leave it as it is: it was measured with a
        model of its own.
        """
        plan = self._plan
        if plan is None:
            return None
        unknown = self._position_unknown(plan, moment)
        if unknown or reference is None:
            return PositionCheck(unknown=unknown or NOT_MEASURED)
        if plan.surface_mm.shape != reference.surface_mm.shape:
            return PositionCheck(unknown=TOO_LITTLE)
        fit = position_between(plan.surface_mm, reference.surface_mm, marker_placement_mm=self._marker_placement_mm)
        if fit is None:
            return PositionCheck(unknown=NO_OVERLAP)
        return PositionCheck(
            shift_mm=_three(fit.shift_mm),
            turn_deg=_three(fit.turn_deg),
            shift_uncertainty_mm=_three(fit.shift_uncertainty_mm),
            turn_uncertainty_deg=_three(fit.turn_uncertainty_deg),
            shape_mm=fit.shape_mm,
        )

    def _position_unknown(self, plan: FirstReference, moment: ReferenceMoment) -> str:
        if plan.calibration_sha256 != self._calibration_sha256:
            return OTHER_CAMERA
        if self._is_camera_lost:
            return AWAY
        if plan.moment is None:
            return NO_MOMENT
        if plan.moment is moment:
            return ""
        return say(
            "the plan's position was set at another moment of the breath ({plan}, not {moment})",
            plan=plan.moment,
            moment=moment,
        )

    def lose_camera(self) -> None:
        """Note that the camera was disconnected: it may have moved, so positions are not comparable any more."""
        self._is_camera_lost = True
        if self._first is not None:
            self._unknown = self._unknown or AWAY

    def doubt_first(self) -> None:
        """Note that this session's first reference was measured by a cold camera; one of before is as it was."""
        if self._is_first_ours:
            self._unknown = self._unknown or COLD

    def transfer(self, transfer: ReferenceTransfer) -> None:
        """Correct the first reference for the other biases of another model, as the reference in use is."""
        first = self._first
        if first is not None and len(first.regions_mm) == len(transfer.regions_mm):
            self._first = replace(
                first,
                regions_mm=frozen(first.regions_mm + transfer.regions_mm),
                volume_l=first.volume_l + transfer.volume_l,
                surface_mm=transfer.applied_to_surface(first.surface_mm),
            )

    def confirm(self, active: PreparedModel, reference: Reference, moment: ReferenceMoment) -> Confirmed:
        """Return the distance of a reference that a person confirmed; the first one is kept."""
        distance = self.distance(active, reference)
        if distance is not None:
            return Confirmed(distance, None)
        self._is_first_ours = True
        self._first = FirstReference(
            calibration_sha256=self._calibration_sha256,
            layout_sha256=self._layout_sha256,
            regions_mm=reference.regions_mm,
            surface_mm=reference.surface_mm,
            plane_mm=reference.plane_mm,
            volume_l=reference.volume_l,
            moment=moment,
        )
        return Confirmed(self.distance(active, reference) or ReferenceDistance(unknown=TOO_LITTLE), self._first)

    def distance(self, active: PreparedModel, reference: Reference | None) -> ReferenceDistance | None:
        """Return how far a reference lies from the first one; None where there is no first one.

        ``reference`` is None for a position that is not measured at present.
        """
        first = self._first
        if first is None:
            return None
        if reference is None or self._unknown:
            return ReferenceDistance(unknown=self._unknown or NOT_MEASURED)
        is_comparable = first.surface_mm.shape == reference.surface_mm.shape
        rigid = rigid_between(first.surface_mm, reference.surface_mm) if is_comparable else None
        if rigid is None or rigid.share < LEAST_SEEN:
            return ReferenceDistance(unknown=TOO_LITTLE)
        levels = (SignalLevel(choice, _level(choice, active, first, reference)) for choice in self._choices)
        return _measured(first, reference, rigid, tuple(levels))


def _three(values: FloatArray) -> tuple[float, float, float]:
    first, second, third = values.tolist()
    return first, second, third


def _level(choice: SignalChoice, active: PreparedModel, first: FirstReference, reference: Reference) -> float:
    """Return the level of a reference in a signal against the first one [mm, l of the volume]; NaN if not known."""
    if choice.is_volume:
        return volume_l(reference.surface_mm, _TRIANGLES, first.plane_mm) - first.volume_l
    position = position_of(choice, active)
    if position is None or not active.regions.is_known[position]:
        return float("nan")
    return float(first.regions_mm[position] - reference.regions_mm[position])


def _measured(
    first: FirstReference, reference: Reference, rigid: RigidFit, levels: tuple[SignalLevel, ...]
) -> ReferenceDistance:
    normal = _normal(first.surface_mm)
    shift_mm = np.array(rigid.shift_mm)
    turned = cv2.Rodrigues(rigid.rotation)[0].ravel()
    height_mm, turn = float(shift_mm @ normal), float(turned @ normal)
    moved_mm = reference.surface_mm - first.surface_mm
    return ReferenceDistance(
        moved_mm=float(np.sqrt(np.nanmean((moved_mm**2).sum(axis=1)))),
        shift_mm=float(np.linalg.norm(shift_mm - height_mm * normal)),
        height_mm=height_mm,
        turn_deg=abs(float(np.rad2deg(turn))),
        tilt_deg=float(np.rad2deg(np.linalg.norm(turned - turn * normal))),
        shape_mm=rigid.shape_mm,
        levels=levels,
        uncertainty_mm=reference.uncertainty_mm,
    )


def _normal(surface_mm: FloatArray) -> FloatArray:
    """Return the normal of a surface's plane, towards the camera, shape (3,)."""
    points = surface_mm[np.isfinite(surface_mm).all(axis=1)]
    normal: FloatArray = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    return -normal if normal[2] > 0.0 else normal
