"""Rule for a played recording with a real beam line: refused unless the site states that no patient can be in the beam.

The patient on the couch is not the recorded one, and the recording breathes independently of the patient.
"""

from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.settings.names import PREFIX
from service.core.settings.settings import Settings

FIELD = "source.kind"
WARNING = "RECORDING: a played recording, and no patient, gates a REAL beam line"


def check_source(source: sessions.RecordingSource | sessions.DeviceSource, settings: Settings) -> None:
    """Refuse a recording where any line is real and the site does not allow it; raise BoundError."""
    if not isinstance(source, sessions.RecordingSource) or not settings.has_real_beam or settings.recordings_may_gate:
        return
    bound = (
        f"a camera: the beam line is real ({' and '.join(settings.beam_lines)}), and what a recording shows is not the "
        f"patient. On a bench without one set {PREFIX}RECORDINGS_MAY_GATE=true"
    )
    raise BoundError(f"{FIELD} must be {bound}", field=FIELD, value=source.kind, bound=bound)


def warning_of_source(
    source: sessions.RecordingSource | sessions.DeviceSource, *, is_simulated_beam: bool
) -> str | None:
    """Return the audit's note for a session whose recording gates a real line."""
    return WARNING if isinstance(source, sessions.RecordingSource) and not is_simulated_beam else None


def described_source(source: sessions.RecordingSource | sessions.DeviceSource, settings: Settings) -> dict[str, object]:
    """Tell the audit, loudly, where a recording gates a real line; nothing otherwise."""
    warning = warning_of_source(source, is_simulated_beam=not settings.has_real_beam)
    return {} if warning is None else {"source_warning": f"{warning} ({' and '.join(settings.beam_lines)})"}
