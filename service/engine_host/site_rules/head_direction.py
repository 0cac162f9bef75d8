"""Rules of the head direction: it fits the room, and the plan's Patient Position.

A patient lies along the couch, with the head towards the gantry (head first) or away from it (feet first). DICOM's
Patient Position (0018,5100) says which, and on which side of the body the patient lies; only supine patients are
measured, because the markers are ordered for a body that is seen from its front.
"""

from engine.core.head_direction import HeadDirection
from service.core.errors import BoundError
from service.core.settings.names import PREFIX
from service.core.settings.settings import Settings

FIELD = "head_direction"
GANTRY_SIDE = f"{PREFIX}GANTRY_SIDE"
HEAD_FIRST_SUPINE, FEET_FIRST_SUPINE = "HFS", "FFS"
SUPPORTED_POSITIONS = (HEAD_FIRST_SUPINE, FEET_FIRST_SUPINE)


def check_head_direction(head: HeadDirection | None, settings: Settings) -> None:
    """Refuse a patient who would lie across the couch; raise BoundError."""
    gantry = settings.gantry_side
    if head is None or gantry is None or head in {gantry, gantry.opposite}:
        return
    bound = f"{gantry} (head first) or {gantry.opposite} (feet first): the gantry is at the {gantry} ({GANTRY_SIDE})"
    raise BoundError(f"{FIELD} must be {bound}", field=FIELD, value=head.value, bound=bound)


def head_of(position: str | None, gantry: HeadDirection | None) -> HeadDirection | None:
    """Return where the head of a patient in this position lies; None if position or room are unknown."""
    if position is None or gantry is None:
        return None
    return gantry if position == HEAD_FIRST_SUPINE else gantry.opposite
