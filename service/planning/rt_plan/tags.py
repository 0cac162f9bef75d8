"""Tags of the plan elements that are read; all other elements are skipped.

By module of DICOM PS3.3: Patient C.7.1.1, RT Series C.8.8.1, SOP Common C.12.1, RT General Plan C.8.8.9, RT Fraction
Scheme C.8.8.13, RT Beams C.8.8.14, RT Ion Beams C.8.8.25, RT Patient Setup C.8.8.12. The patient's name and birth date
are not read.
"""

from collections.abc import Mapping
from enum import IntEnum
from typing import TypeAlias, Union

TagSelection: TypeAlias = Mapping[int, Union[str, "TagSelection"]]
"""Selected tags: the value representation, or for a sequence the selection of each item."""


class Tag(IntEnum):
    """Tags of the elements that are read."""

    MEDIA_SOP_CLASS = 0x00020002
    MEDIA_SOP_INSTANCE = 0x00020003
    TRANSFER_SYNTAX = 0x00020010
    CHARACTER_SET = 0x00080005
    SOP_CLASS = 0x00080016
    SOP_INSTANCE = 0x00080018
    MODALITY = 0x00080060
    PATIENT_ID = 0x00100020
    LABEL = 0x300A0002
    NAME = 0x300A0003
    DATE = 0x300A0006
    INTENT = 0x300A000A
    FRACTION_GROUPS = 0x300A0070
    FRACTION_GROUP_NUMBER = 0x300A0071
    FRACTIONS_PLANNED = 0x300A0078
    NUMBER_OF_BEAMS = 0x300A0080
    BEAM_METERSET = 0x300A0086
    BEAMS = 0x300A00B0
    MACHINE = 0x300A00B2
    METERSET_UNIT = 0x300A00B3
    BEAM_NUMBER = 0x300A00C0
    BEAM_NAME = 0x300A00C2
    BEAM_TYPE = 0x300A00C4
    RADIATION_TYPE = 0x300A00C6
    DELIVERY_TYPE = 0x300A00CE
    CONTROL_POINTS = 0x300A0111
    ENERGY = 0x300A0114
    SETUPS = 0x300A0180
    SETUP_NUMBER = 0x300A0182
    SETUP_LABEL = 0x300A0183
    PATIENT_POSITION = 0x00185100
    ION_BEAMS = 0x300A03A2
    ION_CONTROL_POINTS = 0x300A03A8
    SCAN_MODE = 0x300A0308
    MOTION_SYNCHRONIZATION = 0x300A0410
    TECHNIQUE = 0x00189170
    SIGNAL_SOURCE = 0x00189171
    TECHNIQUE_TEXT = 0x00189185
    REFERENCED_BEAMS = 0x300C0004
    REFERENCED_BEAM_NUMBER = 0x300C0006
    REFERENCED_SETUP_NUMBER = 0x300C006A
    APPROVAL = 0x300E0002


CHARACTERS: TagSelection = {Tag.CHARACTER_SET: "CS"}
"""Every item may declare its own character set."""

META: TagSelection = {Tag.MEDIA_SOP_CLASS: "UI", Tag.MEDIA_SOP_INSTANCE: "UI", Tag.TRANSFER_SYNTAX: "UI"}

_ENERGY: TagSelection = {Tag.ENERGY: "DS"}
_BEAM: TagSelection = {
    **CHARACTERS,
    Tag.MACHINE: "SH",
    Tag.METERSET_UNIT: "CS",
    Tag.BEAM_NUMBER: "IS",
    Tag.BEAM_NAME: "LO",
    Tag.BEAM_TYPE: "CS",
    Tag.RADIATION_TYPE: "CS",
    Tag.DELIVERY_TYPE: "CS",
    Tag.SCAN_MODE: "CS",
    Tag.REFERENCED_SETUP_NUMBER: "IS",
}
_MOTION: TagSelection = {**CHARACTERS, Tag.TECHNIQUE: "CS", Tag.SIGNAL_SOURCE: "CS", Tag.TECHNIQUE_TEXT: "ST"}

PLAN: TagSelection = {
    **CHARACTERS,
    Tag.SOP_CLASS: "UI",
    Tag.SOP_INSTANCE: "UI",
    Tag.MODALITY: "CS",
    Tag.PATIENT_ID: "LO",
    Tag.LABEL: "SH",
    Tag.NAME: "LO",
    Tag.DATE: "DA",
    Tag.INTENT: "CS",
    Tag.FRACTION_GROUPS: {
        Tag.FRACTION_GROUP_NUMBER: "IS",
        Tag.NUMBER_OF_BEAMS: "IS",
        Tag.FRACTIONS_PLANNED: "IS",
        Tag.REFERENCED_BEAMS: {Tag.BEAM_METERSET: "DS", Tag.REFERENCED_BEAM_NUMBER: "IS"},
    },
    Tag.BEAMS: {**_BEAM, Tag.CONTROL_POINTS: _ENERGY},
    Tag.ION_BEAMS: {**_BEAM, Tag.ION_CONTROL_POINTS: _ENERGY},
    Tag.SETUPS: {
        **CHARACTERS,
        Tag.SETUP_NUMBER: "IS",
        Tag.SETUP_LABEL: "LO",
        Tag.PATIENT_POSITION: "CS",
        Tag.MOTION_SYNCHRONIZATION: _MOTION,
    },
    Tag.APPROVAL: "CS",
}


def tag_number(tag: int) -> str:
    """Return a tag as DICOM writes it: ``(300A,00B0)``."""
    return f"({tag >> 16:04X},{tag & 0xFFFF:04X})"


def named(tag: int) -> str:
    """Return a tag with its DICOM name; the number alone if it is not one of `Tag`."""
    from pydicom.datadict import dictionary_description

    return f"{tag_number(tag)} {dictionary_description(tag)}" if tag in _NAMED else tag_number(tag)


_NAMED = frozenset(Tag)
