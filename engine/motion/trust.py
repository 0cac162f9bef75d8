"""Whether the surface in the region can be trusted as this patient's skin: three checks beside the motion model."""

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import FloatArray, Lost, LostReason, Markers, Projection, RgbdFrame, RoiDepth, ThinViews
from engine.core.sentences import say
from engine.motion.cross_check.cross_check import CrossCheck
from engine.motion.cross_check.present_noise import FILTERED_SHARE
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.tracking.surface_continuity import MarkerLayout, ObservedSurface, SurfaceContinuity, marker_points_mm

Depths = tuple[FloatArray, FloatArray]
"""Depth at the nodes and of the regions [mm]."""

LEAST_TRAINED_MM = 2.0
"""Noise of a training [mm, as a model's] below which a filter is not looked for; usual sensors have 5."""


class SurfaceTrust:
    """The markers' layout, a second estimate of the surface, and its continuity; owned by one thread.

    The displayed loss is the first of these three, because a displaced marker explains the other two. The attribute
    `second_estimate` is public: a training learns its shapes of breathing, and a second pass takes them over.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._layout = MarkerLayout()
        self.second_estimate = CrossCheck(calibration)
        self._continuity = SurfaceContinuity()
        self._timestamp_us, self._position_generation = 0, -1
        self._found: Markers | None = None
        self._points_mm: FloatArray | None = None
        self._disagreement: Lost | None = None

    def observe(self, frame: RgbdFrame, views: ThinViews, found: Markers, roi: RoiDepth, thin: RoiDepth) -> None:
        """Take a frame, whether a model explains it or not; ``thin`` is the sampling of ``roi`` that is measured."""
        rays = self._calibration.color.rays(found.centers_px)
        self._timestamp_us, self._found = frame.timestamp_us, found
        self._points_mm = marker_points_mm(rays, roi)
        self.second_estimate.observe(frame, views, found, rays, thin)

    def judge(
        self,
        active: PreparedModel,
        outcome: Projection | Lost,
        noise_mm: float,
        *,
        is_reference_due: bool,
        position_generation: int,
    ) -> tuple[Projection, Depths] | Lost:
        """Return a projected frame with its depths where its surface is trusted, or else why not.

        ``noise_mm`` is the noise that tolerances count with; ``position_generation`` counts the references that a
        person has set: a new one resets layout and continuity. The comparison with the reference needs no projection:
        it is made of a frame that the model does not explain too.
        """
        self._disagreement = self.second_estimate.lost(
            active.model, is_reference_due=is_reference_due, learned=active.beside
        )
        filtered = self._filtered(active)
        if filtered is not None:
            return filtered
        if isinstance(outcome, Lost):
            return outcome
        depths_mm = active.depths_mm(outcome.coefficients)
        untrusted = self._untrusted(active, depths_mm[0], noise_mm, position_generation)
        if untrusted is not None:
            return untrusted
        self.second_estimate.confirm()
        return outcome, depths_mm

    def _untrusted(
        self, active: PreparedModel, node_depth_mm: FloatArray, noise_mm: float, position_generation: int
    ) -> Lost | None:
        """Return why the surface of an explained frame is not trusted, None where it is.

        Where the camera or the couch has moved too, that is named: it explains a surface that has changed. A movement
        alone is a doubt (`CrossCheck.doubt`): the surface is still this patient's skin.
        """
        if position_generation != self._position_generation:
            self._position_generation = position_generation
            self._layout.restart(position_generation)
            self._continuity.restart(position_generation)
        elsewhere = self._layout.lost(self._points_mm, self._timestamp_us)
        if elsewhere is not None:
            return elsewhere
        lost = self._disagreement or self._discontinuity(active, node_depth_mm, noise_mm)
        return None if lost is None else self.second_estimate.doubt or lost

    def _discontinuity(self, active: PreparedModel, node_depth_mm: FloatArray, noise_mm: float) -> Lost | None:
        if self._found is None:
            return None
        observed = ObservedSurface(
            depth_mm=node_depth_mm, markers_px=self._found.centers_px, timestamp_us=self._timestamp_us
        )
        modes = active.node_modes[: active.basis.components]
        detail = self._continuity.rejection(observed, modes, noise_mm)
        return Lost(reason=LostReason.RESIDUAL_HIGH, detail=detail) if detail else None

    def _filtered(self, active: PreparedModel) -> Lost | None:
        """Return the loss of frames whose depth has far less noise than the training had; None where it has not."""
        trained_mm, noise = active.model.noise_mm, self.second_estimate.noise
        if trained_mm < LEAST_TRAINED_MM or not noise.share_soon(trained_mm) < FILTERED_SHARE:
            return None
        detail = say(
            "the depth has only {share:.0%} of the noise of the training: the camera or its driver averages pictures "
            "over time, or the training was in bad light. Check the camera, then train again",
            share=noise.share_soon(trained_mm),
        )
        return Lost(reason=LostReason.FRAME_FROZEN, detail=detail)

    def interrupt(self, lost: Lost) -> None:
        """Take note that the frame was lost: what another surface may have replaced is doubted."""
        if lost.reason in {LostReason.RESIDUAL_HIGH, LostReason.SURFACE_CHANGED}:
            self._continuity.interrupt()
