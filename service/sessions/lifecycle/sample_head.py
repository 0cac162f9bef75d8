"""The metadata of a session's sample file: software, settings, calibration and model."""

from engine import __version__
from service.core.settings.settings import Settings
from service.engine_host.roles import SessionPlan
from service.storage.audit.startup import redacted_settings, settings_sha256
from service.storage.database.base import utc_text
from service.storage.samples.layout import SampleHead
from service.storage.time_anchor import TimeAnchor


def sample_head(plan: SessionPlan, settings: Settings, anchor: TimeAnchor) -> SampleHead:
    """Make the head of a session's file."""
    return SampleHead(
        session_id=plan.session_id,
        software=f"tidegate {__version__}",
        settings_sha256=settings_sha256(redacted_settings(settings)),
        calibration_sha256=plan.calibration.sha256,
        model_id=plan.model_id or "",
        regions=tuple(region.name for region in plan.regions.named),
        utc=utc_text(anchor.at),
        monotonic_ns=anchor.at_ns,
    )
