"""A played recording before a real beam line: refused, unless the site says that no patient can be in that beam.

Whoever lies on the couch is not who was recorded, and a film breathes on whatever the patient does.
"""

from service import schemas
from service.beam_settings import PREFIX
from service.errors import BoundError
from service.settings import Settings

FIELD = "source.kind"
WARNING = "RECORDING: a played recording, and no patient, gates a REAL beam line"


def check_source(source: schemas.RecordingSource | schemas.DeviceSource, settings: Settings) -> None:
    """Refuse a recording where any line is real and the site does not allow it; raise BoundError."""
    if not isinstance(source, schemas.RecordingSource) or not settings.has_real_beam or settings.recordings_may_gate:
        return
    bound = (
        f"a camera: the beam line is real ({' and '.join(settings.beam_lines)}), and what a recording shows is not the "
        f"patient. On a bench without one set {PREFIX}RECORDINGS_MAY_GATE=true"
    )
    raise BoundError(f"{FIELD} must be {bound}", field=FIELD, value=source.kind, bound=bound)


def warning_of_source(source: schemas.RecordingSource | schemas.DeviceSource, *, is_simulated_beam: bool) -> str | None:
    """Return what has to be said beside a session whose recording gates a real line."""
    return WARNING if isinstance(source, schemas.RecordingSource) and not is_simulated_beam else None


def described_source(source: schemas.RecordingSource | schemas.DeviceSource, settings: Settings) -> dict[str, object]:
    """Tell the audit, loudly, where a recording gates a real line; nothing otherwise."""
    warning = warning_of_source(source, is_simulated_beam=not settings.has_real_beam)
    return {} if warning is None else {"source_warning": f"{warning} ({' and '.join(settings.beam_lines)})"}
