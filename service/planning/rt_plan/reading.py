"""Read an RT Plan or RT Ion Plan from bytes to the elements that Tidegate uses. Pure: no file, clock or network."""

from collections.abc import Iterable

from service.core.schemas.plans import (
    PlanBeam,
    PlanFractionBeam,
    PlanFractionGroup,
    PlanKind,
    PlanMotion,
    PlanSetup,
    RtPlan,
)
from service.planning.rt_plan.errors import PlanError, PlanKindError
from service.planning.rt_plan.gating import foreign_signals, prescribed, remark
from service.planning.rt_plan.part10 import ElementReader, open_file, plain_uid
from service.planning.rt_plan.tags import PLAN, Tag, named
from service.planning.rt_plan.values import Elements, elements_of

KINDS: dict[str, PlanKind] = {
    "1.2.840.10008.5.1.4.1.1.481.5": "RT Plan",
    "1.2.840.10008.5.1.4.1.1.481.8": "RT Ion Plan",
}
MODALITY = "RTPLAN"
MAX_BEAMS = 256
MAX_GROUPS = 64
MAX_SETUPS = 256
MAX_MOTIONS = 16
MAX_CONTROL_POINTS = 20_000
MAX_ENERGIES = 512
MAX_FRACTIONS = 999
MAX_NUMBER = 2_147_483_647
MAX_METERSET = 1e7
MAX_ENERGY = 1e4
NOT_FOR_PATIENTS = frozenset({"VERIFICATION", "MACHINE_QA", "RESEARCH", "SERVICE"})
_UNITS = {"PHOTON": "MV", "ELECTRON": "MeV", "PROTON": "MeV/u", "ION": "MeV/u"}


def read_plan(content: bytes) -> RtPlan:
    """Read a plan; the limits of `service.planning.rt_plan.part10` bound the work for any bytes.

    Raises
    ------
    PlanError
        The bytes are no DICOM file, no plan, cut off, over a limit, or a plan with impossible values. No other error.
    """
    file = open_file(content)
    _check_kind(plain_uid(file.meta, Tag.MEDIA_SOP_CLASS), Tag.MEDIA_SOP_CLASS)
    plan = elements_of(ElementReader(data=file.data).dataset(file.start, file.form, PLAN))
    kind = _check_kind(plan.uid(Tag.SOP_CLASS), Tag.SOP_CLASS)
    uid = plan.uid(Tag.SOP_INSTANCE)
    if (plain_uid(file.meta, Tag.MEDIA_SOP_CLASS), plain_uid(file.meta, Tag.MEDIA_SOP_INSTANCE)) != (
        plan.uid(Tag.SOP_CLASS),
        uid,
    ):
        raise plan.refusal(Tag.SOP_INSTANCE, uid, "equal to the file's meta information")
    modality = plan.code(Tag.MODALITY)
    if modality != MODALITY:
        raise plan.refusal(Tag.MODALITY, modality or "missing", MODALITY)
    setups = [_setup(item) for item in plan.items(Tag.SETUPS, most=MAX_SETUPS)]
    _each_once((setup.number for setup in setups), plan, Tag.SETUPS, Tag.SETUP_NUMBER)
    beams = _beams(plan, kind, setups)
    groups = _groups(plan, beams)
    gating = prescribed(beams, setups)
    label, patient = plan.text(Tag.LABEL, 16), plan.text(Tag.PATIENT_ID, 64)
    for tag, value in ((Tag.LABEL, label), (Tag.PATIENT_ID, patient)):
        if value is None:
            raise plan.refusal(tag, "missing", "given")
    intent, approval = plan.code(Tag.INTENT), plan.code(Tag.APPROVAL)
    return RtPlan(
        kind=kind,
        sop_instance_uid=uid,
        patient_reference=patient or "",
        label=label or "",
        name=plan.text(Tag.NAME, 64),
        date=plan.date(Tag.DATE),
        intent=intent,
        approval=approval,
        fraction_groups=groups,
        beams=beams,
        setups=setups,
        gating=gating,
        notes=[*_notes(intent, approval), *_gating_notes(remark(gating), setups), *_fraction_notes(groups)],
        character_set=plan.character_terms,
    )


def _check_kind(sop_class: str, tag: Tag) -> PlanKind:
    if sop_class not in KINDS:
        bound = " or ".join(f"{uid} ({kind} Storage)" for uid, kind in KINDS.items())
        msg = f"the file is no plan: {named(tag)} is {sop_class}, must be {bound}"
        raise PlanKindError(msg, field=named(tag), value=sop_class, bound=bound)
    return KINDS[sop_class]


def _beams(plan: Elements, kind: PlanKind, setups: list[PlanSetup]) -> list[PlanBeam]:
    tag = Tag.BEAMS if kind == "RT Plan" else Tag.ION_BEAMS
    points = Tag.CONTROL_POINTS if kind == "RT Plan" else Tag.ION_CONTROL_POINTS
    items = plan.items(tag, most=MAX_BEAMS)
    if not items:
        raise plan.refusal(tag, "missing", "a plan with beams; brachytherapy is not gated here")
    beams = [_beam(item, points, {setup.number for setup in setups}) for item in items]
    _each_once((beam.number for beam in beams), plan, tag, Tag.BEAM_NUMBER)
    return beams


def _beam(item: Elements, points: Tag, setups: set[int]) -> PlanBeam:
    radiation = item.code(Tag.RADIATION_TYPE)
    setup = item.integer(Tag.REFERENCED_SETUP_NUMBER, 0, MAX_NUMBER)
    if setup is not None and setup not in setups:
        raise item.refusal(Tag.REFERENCED_SETUP_NUMBER, str(setup), "the number of one of the plan's setups")
    energies = _energies(item.items(points, most=MAX_CONTROL_POINTS))
    if len(energies) > MAX_ENERGIES:
        raise item.refusal(points, f"{len(energies)} energies", f"at most {MAX_ENERGIES} energies")
    return PlanBeam(
        number=item.number(Tag.BEAM_NUMBER, 0, MAX_NUMBER),
        name=item.text(Tag.BEAM_NAME, 64),
        type=item.code(Tag.BEAM_TYPE),
        radiation=radiation,
        delivery=item.code(Tag.DELIVERY_TYPE),
        machine=item.text(Tag.MACHINE, 16),
        scan_mode=item.code(Tag.SCAN_MODE),
        energies=energies,
        energy_unit=_UNITS.get(radiation or "") if energies else None,
        setup_number=setup,
    )


def _energies(points: Iterable[Elements]) -> list[float]:
    found = (point.decimal(Tag.ENERGY, 0.0, MAX_ENERGY) for point in points)
    return sorted({energy for energy in found if energy is not None})


def _groups(plan: Elements, beams: list[PlanBeam]) -> list[PlanFractionGroup]:
    items = plan.items(Tag.FRACTION_GROUPS, most=MAX_GROUPS)
    if not items:
        raise plan.refusal(Tag.FRACTION_GROUPS, "missing", "a plan with fractions")
    groups = [_group(item, {beam.number for beam in beams}) for item in items]
    _each_once((group.number for group in groups), plan, Tag.FRACTION_GROUPS, Tag.FRACTION_GROUP_NUMBER)
    return groups


def _group(item: Elements, beams: set[int]) -> PlanFractionGroup:
    given = [_fraction_beam(one, beams) for one in item.items(Tag.REFERENCED_BEAMS, most=MAX_BEAMS)]
    _each_once((one.beam_number for one in given), item, Tag.REFERENCED_BEAMS, Tag.REFERENCED_BEAM_NUMBER)
    announced = item.integer(Tag.NUMBER_OF_BEAMS, 0, MAX_BEAMS)
    if announced is not None and announced != len(given):
        bound = f"the number of beams that the group refers to, {len(given)}: the gating of a missing one is not known"
        raise item.refusal(Tag.NUMBER_OF_BEAMS, str(announced), bound)
    return PlanFractionGroup(
        number=item.number(Tag.FRACTION_GROUP_NUMBER, 0, MAX_NUMBER),
        fractions_planned=item.integer(Tag.FRACTIONS_PLANNED, 1, MAX_FRACTIONS),
        beams=given,
    )


def _fraction_beam(item: Elements, beams: set[int]) -> PlanFractionBeam:
    number = item.number(Tag.REFERENCED_BEAM_NUMBER, 0, MAX_NUMBER)
    if number not in beams:
        raise item.refusal(Tag.REFERENCED_BEAM_NUMBER, str(number), "the number of one of the plan's beams")
    return PlanFractionBeam(beam_number=number, meterset=item.decimal(Tag.BEAM_METERSET, 0.0, MAX_METERSET))


def _setup(item: Elements) -> PlanSetup:
    return PlanSetup(
        number=item.number(Tag.SETUP_NUMBER, 0, MAX_NUMBER),
        label=item.text(Tag.SETUP_LABEL, 64),
        position=item.code(Tag.PATIENT_POSITION),
        motion=[_motion(one) for one in item.items(Tag.MOTION_SYNCHRONIZATION, most=MAX_MOTIONS)],
    )


def _motion(item: Elements) -> PlanMotion:
    technique = item.code(Tag.TECHNIQUE)
    if technique is None:
        raise item.refusal(Tag.TECHNIQUE, "missing", "given where motion is synchronised")
    return PlanMotion(
        technique=technique,
        signal_source=item.code(Tag.SIGNAL_SOURCE),
        description=item.remark(Tag.TECHNIQUE_TEXT, 200),
    )


def _each_once(numbers: Iterable[int], around: Elements, sequence: Tag, tag: Tag) -> None:
    """Refuse a number that occurs twice: a reference to it would be ambiguous."""
    seen: set[int] = set()
    for number in numbers:
        if number in seen:
            place = f"{around.place}{named(sequence)}"
            msg = f"{place} has {named(tag)} {number} twice"
            raise PlanError(msg, field=place, value=str(number), bound=f"each {named(tag)} once")
        seen.add(number)


def _notes(intent: str | None, approval: str | None) -> list[str]:
    notes = [f"the plan's intent is {intent}"] if intent in NOT_FOR_PATIENTS else []
    if approval != "APPROVED":
        notes.append(f"the plan is not approved: {named(Tag.APPROVAL)} is {approval or 'missing'}")
    return notes


def _gating_notes(note: str | None, setups: list[PlanSetup]) -> list[str]:
    signals = foreign_signals(setups)
    names = ", ".join(signals)
    notes = [f"the plan's breathing signal is {names}; Tidegate measures the surface"] if signals else []
    return ([note] if note else []) + notes


def _fraction_notes(groups: list[PlanFractionGroup]) -> list[str]:
    open_ended = [group.number for group in groups if group.fractions_planned is None]
    return [f"fraction group {number} has no number of planned fractions" for number in open_ended]
