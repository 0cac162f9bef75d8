"""A played recording before a real beam line: refused, unless the site says that no patient can be in that beam.

Whoever lies on the couch is not who was recorded, and a film breathes on whatever the patient does.
"""

from service import schemas
from service.beam_settings import PREFIX
from service.errors import BoundError
from service.settings import Settings

FIELD = "source.kind"


def check_source(source: schemas.RecordingSource | schemas.DeviceSource, settings: Settings) -> None:
    """Refuse a recording where any line is real and the site does not allow it; raise BoundError."""
    if not _plays_to_a_real_beam(source, settings) or settings.recordings_may_gate:
        return
    bound = (
        f"a camera: the beam line is real ({' and '.join(settings.beam_lines)}), and what a recording shows is not the "
        f"patient. On a bench without one set {PREFIX}RECORDINGS_MAY_GATE=true"
    )
    raise BoundError(f"{FIELD} must be {bound}", field=FIELD, value=source.kind, bound=bound)


def described_source(source: schemas.RecordingSource | schemas.DeviceSource, settings: Settings) -> dict[str, object]:
    """Tell the audit, loudly, where a recording gates a real line; nothing otherwise."""
    if not _plays_to_a_real_beam(source, settings):
        return {}
    lines = " and ".join(settings.beam_lines)
    return {"source_warning": f"RECORDING: a played recording, and no patient, gates a REAL beam line ({lines})"}


def _plays_to_a_real_beam(source: schemas.RecordingSource | schemas.DeviceSource, settings: Settings) -> bool:
    return isinstance(source, schemas.RecordingSource) and settings.has_real_beam
