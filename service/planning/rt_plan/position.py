"""The head direction that a plan's Patient Position (0018,5100) demands in this room.

The position is in the patient setups of the fraction's treatment beams (PS3.3 C.8.8.12; terms in C.7.3.1.1.2). Only
supine patients are measured: the markers are ordered for a body that is seen from its front.
"""

from collections.abc import Iterable

from engine.core.head_direction import HeadDirection
from service.core.schemas.plans import PlanBeam, PlanSetup
from service.engine_host.site_rules.head_direction import FIELD, GANTRY_SIDE, SUPPORTED_POSITIONS, head_of
from service.planning.rt_plan.errors import PlanPositionError
from service.planning.rt_plan.gating import NOT_TREATED
from service.planning.rt_plan.tags import Tag, named


def position_of(beams: Iterable[PlanBeam], setups: Iterable[PlanSetup]) -> str | None:
    """Return the position of the treatment beams; None if the plan has none.

    Raises
    ------
    PlanPositionError
        The patient does not lie supine along the couch, or not in the same position for all beams.
    """
    known = list(setups)
    treated = [beam for beam in beams if beam.delivery not in NOT_TREATED]
    own = [setup for beam in treated for setup in known if beam.setup_number in {None, setup.number}]
    found = sorted({setup.position for setup in own if setup.position is not None})
    if len(found) > 1:
        raise _refused(", ".join(found), "the same for all beams of the fraction")
    if found and found[0] not in SUPPORTED_POSITIONS:
        raise _refused(found[0], f"{' or '.join(SUPPORTED_POSITIONS)}: only supine patients are measured")
    return found[0] if found else None


def head_direction(
    requested: HeadDirection | None, position: str | None, gantry: HeadDirection | None
) -> HeadDirection | None:
    """Return the session's head direction: as requested, otherwise as plan and room say; None if neither is known.

    Raises
    ------
    PlanPositionError
        The request contradicts plan and room.
    """
    planned = head_of(position, gantry)
    if requested is not None and planned is not None and requested is not planned:
        bound = f"{planned}: the plan's position is {position}, and the gantry is at the {gantry} ({GANTRY_SIDE})"
        raise PlanPositionError(f"{FIELD} must be {bound}", field=FIELD, value=requested.value, bound=bound)
    return requested or planned


def position_notes(head: HeadDirection | None, position: str | None, gantry: HeadDirection | None) -> list[str]:
    """Return what could not be compared, for the operator."""
    notes = []
    if position is None:
        notes.append("the plan has no Patient Position: the head direction is not compared with it")
    elif gantry is None:
        notes.append(f"the head direction is not compared with the plan's position {position}: set {GANTRY_SIDE}")
    if head is None:
        notes.append("without a head direction only the whole region and its volume may gate")
    return notes


def _refused(value: str, bound: str) -> PlanPositionError:
    element = named(Tag.PATIENT_POSITION)
    return PlanPositionError(f"{element} is {value}: must be {bound}", field=element, value=value, bound=bound)
