"""What is read of a plan, however it is written; made by pydicom, which shares no line with our reader's walk."""

import io

import pydicom
import pytest

from service.planning.rt_plan.reading import read_plan
from tests.support.planning.dicom_plans import (
    PATIENT_NAME,
    SYNTAXES,
    UID,
    beam,
    group,
    ion_beam,
    ion_plan,
    made,
    motion,
    open_lengths,
    photon_plan,
    setup,
    written,
)
from tests.support.planning.refusals import refused


@pytest.mark.parametrize("syntax", SYNTAXES)
@pytest.mark.parametrize("lengths", [lambda plan: plan, open_lengths], ids=["known lengths", "open lengths"])
@pytest.mark.parametrize("make", [photon_plan, ion_plan])
def test_a_plan_states_the_same_however_it_is_written(make, lengths, syntax):
    assert read_plan(written(lengths(make()), syntax)) == read_plan(written(make()))


def test_a_photon_plan_is_read_with_its_fractions_beams_and_setups():
    plan = read_plan(
        written(
            photon_plan(
                BeamSequence=[beam(1), beam(2, energies=(6.0, 10.0, 6.0), BeamType="STATIC")],
                FractionGroupSequence=[group(1, beams=(1, 2), fractions=25)],
            )
        )
    )
    assert (plan.kind, plan.sop_instance_uid, plan.patient_reference) == ("RT Plan", UID, "P-0001")
    assert (plan.label, plan.name, plan.date) == ("LUNG_DIBH", "Lung left", "20261120")
    assert (plan.intent, plan.approval, plan.notes) == ("CURATIVE", "APPROVED", [])
    assert [(one.number, one.fractions_planned, len(one.beams)) for one in plan.fraction_groups] == [(1, 25, 2)]
    assert plan.fraction_groups[0].beams[1].meterset == 123.4
    assert [(one.number, one.name, one.type, one.energies) for one in plan.beams] == [
        (1, "Beam 1", "DYNAMIC", [6.0]),
        (2, "Beam 2", "STATIC", [6.0, 10.0]),
    ]
    assert {(one.machine, one.radiation, one.energy_unit, one.setup_number) for one in plan.beams} == {
        ("LINAC1", "PHOTON", "MV", 1)
    }


def test_an_ion_plan_is_read_with_the_energies_of_its_layers():
    layers = tuple(70.0 + step / 2 for step in range(200))
    plan = read_plan(written(ion_plan(IonBeamSequence=[ion_beam(energies=layers)])))
    assert (plan.kind, plan.gating) == ("RT Ion Plan", "gating")
    assert (plan.beams[0].radiation, plan.beams[0].scan_mode, plan.beams[0].energy_unit) == (
        "PROTON",
        "MODULATED",
        "MeV/u",
    )
    assert plan.beams[0].energies == list(layers)


@pytest.mark.parametrize("make", [photon_plan, ion_plan])
def test_what_is_read_is_what_pydicom_reads(make):
    """The second reader: somebody else's, over the same bytes."""
    content = written(make())
    ours, theirs = read_plan(content), pydicom.dcmread(io.BytesIO(content))
    beams = theirs.get("BeamSequence") or theirs.get("IonBeamSequence")
    assert [one.number for one in ours.beams] == [int(one.BeamNumber) for one in beams]
    assert (ours.label, ours.patient_reference) == (theirs.RTPlanLabel, theirs.PatientID)
    terms = theirs.PatientSetupSequence[0].MotionSynchronizationSequence[0]
    assert ours.setups[0].motion[0].technique == terms.RespiratoryMotionCompensationTechnique


@pytest.mark.parametrize(
    ("terms", "label"),
    [
        ("ISO_IR 192", "肺・息止め"),
        ("ISO_IR 100", "Brüste links"),
        (["", "ISO 2022 IR 87"], "肺 DIBH"),
        (["ISO 2022 IR 13", "ISO 2022 IR 87"], "ﾊｲ 肺"),
        ("GB18030", "肺部呼吸"),
        ("ISO_IR 144", "Лёгкое"),
    ],
)
def test_names_come_in_the_characters_of_their_country(terms, label):
    plan = photon_plan(SpecificCharacterSet=terms, RTPlanLabel=label, BeamSequence=[beam(BeamName=label)])
    found = read_plan(written(plan))
    assert (found.label, found.beams[0].name) == (label, label)


@pytest.mark.parametrize("terms", ["\\ISO 2022 IR 58", "ISO 2022 IR 6\\ISO 2022 IR 58"])
def test_a_chinese_name_is_read_by_the_bytes_of_the_standard(terms):
    """PS3.5, K: the bytes are written by hand, for a library's reader and writer share its mistakes."""
    left_lung = b"\x1b$)A\xd7\xf3\xb7\xce"
    written_by_hand = {
        left_lung: "左肺",
        b"A " + left_lung: "A 左肺",
        left_lung + b"\x1b(B B": "左肺 B",
    }
    for raw, text in written_by_hand.items():
        plan = photon_plan(RTPlanLabel="LABEL", RTPlanName="@" * len(raw))
        plan.SpecificCharacterSet = "ISO_IR 100"
        content = written(plan).replace(b"@" * len(raw), raw, 1)
        assert read_plan(with_character_set(content, terms)).name == text


def with_character_set(content, terms):
    """Change the characters that a file declares in ISO_IR 100."""
    declared = terms.encode() + b" " * (len(terms) % 2)
    begin = content.index(b"\x08\x00\x05\x00CS")
    return content[: begin + 6] + len(declared).to_bytes(2, "little") + declared + content[begin + 18 :]


@pytest.mark.parametrize("announced", [0, 1, 3])
def test_a_group_that_announces_another_number_of_beams_is_refused(announced):
    """The beam that is missing may need another technique: a breath hold, beside one that is gated."""
    groups = [group(beams=(1, 2))]
    groups[0].NumberOfBeams = announced
    error = refused(written(photon_plan(BeamSequence=[beam(), beam(2)], FractionGroupSequence=groups)))
    assert error.field.endswith("(300A,0080) Number of Beams")
    assert error.value == str(announced)


def test_an_item_may_be_written_in_other_characters_than_what_is_around_it():
    other = setup(1, motion(), SpecificCharacterSet="ISO_IR 192", PatientSetupLabel="仰臥位")
    found = read_plan(written(photon_plan(SpecificCharacterSet="ISO_IR 100", PatientSetupSequence=[other])))
    assert found.setups[0].label == "仰臥位"


def test_the_patients_name_and_birth_date_are_nowhere_in_what_is_read():
    reported = read_plan(written(photon_plan())).model_dump_json()
    assert not any(one in reported for one in (*PATIENT_NAME.split("^"), "1950"))


def test_private_elements_are_stepped_over_whatever_is_in_them():
    plan = photon_plan()
    plan.private_block(0x300B, "SOMEBODY", create=True).add_new(1, "OB", b"\xff" * 4096)
    plan.private_block(0x300B, "SOMEBODY").add_new(2, "SQ", [made(PatientName="x")])
    assert read_plan(written(plan)) == read_plan(written(photon_plan()))


def test_a_sequence_that_somebody_kept_as_unknown_is_read_all_the_same():
    """An archive that does not know a tag keeps it as UN, with what is inside in the implicit form (PS3.5, 6.2.2)."""
    content = written(photon_plan(PatientSetupSequence=None, BeamSequence=[beam(setup_number=None)]))
    inner = written(photon_plan(), "implicit little")
    start = inner.index(b"\x0a\x30\x80\x01")
    length = int.from_bytes(inner[start + 4 : start + 8], "little")
    unknown = b"\x0a\x30\x80\x01UN\0\0" + length.to_bytes(4, "little") + inner[start + 8 : start + 8 + length]
    at = content.index(b"\x0e\x30\x02\x00CS")  # Approval Status is what follows
    assert read_plan(content[:at] + unknown + content[at:]).setups[0].motion[0].technique == "BREATH_HOLD"


GATINGS = [
    ([setup(1, motion("BREATH_HOLD"))], "breath_hold"),
    ([setup(1, motion("GATING"))], "gating"),
    ([setup(1, motion("NONE", "NONE"))], "none"),
    ([setup(1)], "not_stated"),
    (None, "not_stated"),
    ([setup(1, motion("UNKNOWN"))], "unknown"),
    ([setup(1, motion("TRACKING"))], "other"),
    ([setup(1, motion("VENDOR_TERM"))], "other"),
    ([setup(1, motion("BREATH_HOLD"), motion("GATING"))], "mixed"),
]


@pytest.mark.parametrize(("setups", "prescribed"), GATINGS)
def test_what_the_plan_prescribes_about_breathing_is_reported_in_our_words(setups, prescribed):
    number = None if setups is None else 1
    plan = photon_plan(PatientSetupSequence=setups, BeamSequence=[beam(setup_number=number)])
    assert read_plan(written(plan)).gating == prescribed


def test_only_the_setups_of_beams_that_treat_have_a_say():
    beams = [beam(1, setup_number=1), beam(2, setup_number=2, TreatmentDeliveryType="SETUP")]
    setups = [setup(1, motion("GATING")), setup(2, motion("BREATH_HOLD")), setup(3, motion("TRACKING"))]
    plan = photon_plan(BeamSequence=beams, PatientSetupSequence=setups)
    assert read_plan(written(plan)).gating == "gating"


def test_a_beam_that_names_no_setup_may_be_of_any_of_them():
    plan = photon_plan(
        BeamSequence=[beam(1, setup_number=None)],
        PatientSetupSequence=[setup(1, motion("GATING")), setup(2, motion("BREATH_HOLD"))],
    )
    assert read_plan(written(plan)).gating == "mixed"


def test_what_a_person_should_know_is_noted():
    plan = photon_plan(
        ApprovalStatus="UNAPPROVED",
        PlanIntent="VERIFICATION",
        PatientSetupSequence=[setup(1, motion("GATING", "SPIROMETER")), setup(2)],
        FractionGroupSequence=[group(fractions=None)],
    )
    notes = " / ".join(read_plan(written(plan)).notes)
    for word in ("VERIFICATION", "UNAPPROVED", "SPIROMETER", "number of planned fractions"):
        assert word in notes
    silent = photon_plan(PatientSetupSequence=None, BeamSequence=[beam(setup_number=None)], ApprovalStatus=None)
    assert any("prescribes no gating" in note for note in read_plan(written(silent)).notes)


NOT_TRUE = [
    ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.2"}, "plan_wrong_kind", "SOP Class UID"),
    ({"Modality": "CT"}, "plan_invalid", "(0008,0060) Modality"),
    ({"Modality": None}, "plan_invalid", "(0008,0060) Modality"),
    ({"PatientID": None}, "plan_invalid", "(0010,0020) Patient ID"),
    ({"PatientID": ""}, "plan_invalid", "(0010,0020) Patient ID"),
    ({"RTPlanLabel": None}, "plan_invalid", "(300A,0002) RT Plan Label"),
    ({"FractionGroupSequence": None}, "plan_invalid", "(300A,0070) Fraction Group Sequence"),
    ({"BeamSequence": None}, "plan_invalid", "(300A,00B0) Beam Sequence"),
    ({"BeamSequence": [beam(1), beam(1)]}, "plan_invalid", "(300A,00B0) Beam Sequence"),
    ({"FractionGroupSequence": [group(1), group(1)]}, "plan_invalid", "(300A,0070) Fraction Group Sequence"),
    ({"FractionGroupSequence": [group(beams=(7,))]}, "plan_invalid", "Referenced Beam Number"),
    ({"FractionGroupSequence": [group(fractions=0)]}, "plan_invalid", "Number of Fractions Planned"),
    ({"FractionGroupSequence": [group(fractions=1000)]}, "plan_invalid", "Number of Fractions Planned"),
    ({"BeamSequence": [beam(setup_number=9)]}, "plan_invalid", "Referenced Patient Setup Number"),
    ({"PatientSetupSequence": [setup(1), setup(1)]}, "plan_invalid", "(300A,0180) Patient Setup Sequence"),
    ({"PatientSetupSequence": [setup(1, made(RespiratorySignalSource="BELT"))]}, "plan_invalid", "(0018,9170)"),
    ({"BeamSequence": [beam(number) for number in range(1, 258)]}, "plan_invalid", "(300A,00B0) Beam Sequence"),
]


@pytest.mark.parametrize(("changes", "code", "field"), NOT_TRUE)
def test_a_plan_that_cannot_be_true_is_refused_by_its_tag(changes, code, field):
    error = refused(written(photon_plan(**changes)))
    assert error.code == code
    assert field in str(error.field)


def test_where_in_the_file_it_is_wrong_is_reported():
    plan = photon_plan(
        BeamSequence=[beam(1), beam(2, energies=(6.0, 1e6))], FractionGroupSequence=[group(beams=(1, 2))]
    )
    error = refused(written(plan))
    assert error.field == "(300A,00B0)[2].(300A,0111)[2].(300A,0114) Nominal Beam Energy"
    assert error.value == "1000000.0"


def patched(content: bytes, old: bytes, new: bytes) -> bytes:
    assert content.count(old) >= 1
    assert len(old) == len(new)
    return content.replace(old, new)


ABSURD = [b"1e400", b"nan  ", b"inf  ", b"1e-9x", b"0x10 ", b"1,5  ", b"1\\2  ", b"-1   ", b"     "[:4] + b"-"]


@pytest.mark.parametrize("written_as", ABSURD)
def test_no_number_is_taken_that_is_none(written_as):
    content = written(photon_plan())
    error = refused(patched(content, b"123.4", written_as))
    assert "(300A,0086) Beam Meterset" in str(error.field)


@pytest.mark.parametrize("written_as", [b"9999999999", b"-999999999", b"3000000000", b"1.5e3     ", b"0b11      "])
def test_no_whole_number_is_taken_that_is_none_or_overflows(written_as):
    plan = photon_plan(BeamSequence=[beam(2147483647)], FractionGroupSequence=[group(beams=(2147483647,))])
    error = refused(patched(written(plan), b"2147483647", written_as))
    assert "Number" in str(error.field)


def test_undeclared_characters_are_refused_and_never_guessed():
    content = written(photon_plan())
    error = refused(patched(content, b"LUNG_DIBH", b"LUNG_D\xd6BH"))
    assert error.field == "(300A,0002) RT Plan Label"
    assert "Specific Character Set" in str(error.bound)
    for terms in ("ISO_IR 999", "utf-8", ["ISO_IR 192", "ISO 2022 IR 87"]):
        plan = photon_plan(RTPlanLabel="X")
        plan.SpecificCharacterSet = "ISO_IR 100"
        raw = written(plan)
        reported = "\\".join([terms] if isinstance(terms, str) else terms).encode()
        reported += b" " * (len(reported) % 2)
        begin = raw.index(b"\x08\x00\x05\x00CS")
        content = raw[: begin + 6] + len(reported).to_bytes(2, "little") + reported + raw[begin + 18 :]
        assert refused(content).field == "(0008,0005) Specific Character Set"


def test_characters_are_exactly_those_declared():
    reported = photon_plan(SpecificCharacterSet="ISO_IR 6")
    assert "Specific" in str(refused(patched(written(reported), b"LUNG_DIBH", b"LUNG_D\xd6BH")).bound)
    japanese = photon_plan(SpecificCharacterSet=["", "ISO 2022 IR 87"], RTPlanLabel="肺")
    other = patched(written(japanese), b"ISO 2022 IR 87", b"ISO 2022 IR 13")
    assert "Specific" in str(refused(other).bound)


def test_one_value_is_asked_for_and_one_is_taken():
    assert "one value" in str(refused(patched(written(photon_plan()), b"P-0001", b"P-\\001")).bound)


@pytest.mark.filterwarnings("ignore:The value length")
def test_a_text_longer_than_its_representation_allows_is_refused():
    assert read_plan(written(photon_plan(RTPlanLabel="x" * 16))).label == "x" * 16
    for changes in ({"RTPlanLabel": "x" * 17}, {"PatientID": "x" * 65}):
        assert "characters" in str(refused(written(photon_plan(**changes))).bound)


def test_a_refusal_never_states_what_a_text_states():
    label = refused(patched(written(photon_plan()), b"LUNG_DIBH", b"ANNA\x07MUST"))
    patient = refused(patched(written(photon_plan()), b"P-0001", b"AN\\NA\x07"))
    for error in (label, patient):
        assert "ANNA" not in f"{error} {error.field} {error.value} {error.bound}"
        assert "NA\x07" not in f"{error.value}"


def test_a_file_whose_meta_information_names_another_plan_is_refused():
    error = refused(written(photon_plan(), MediaStorageSOPInstanceUID="1.2.3"))
    assert error.field == "(0008,0018) SOP Instance UID"
