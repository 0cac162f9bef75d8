"""Bytes that are no plan, no plan any more, or a malicious plan: refused by a code, in bounded work."""

import struct
import tracemalloc
import zlib

import pytest
from hypothesis import example, given, settings, strategies as st

from service.core.schemas.plans import RtPlan
from service.planning.rt_plan import part10
from service.planning.rt_plan.errors import PlanError
from service.planning.rt_plan.part10 import MAX_DEPTH, MAX_ELEMENTS, MAX_INFLATED_BYTES, MAX_ITEMS
from service.planning.rt_plan.reading import read_plan
from tests.support.planning.dicom_plans import SYNTAXES, beam, ion_plan, open_lengths, photon_plan, written
from tests.support.planning.refusals import refused

pytestmark = pytest.mark.slow

EXPLICIT = written(photon_plan())
FILES = [written(open_lengths(photon_plan()), syntax) for syntax in SYNTAXES] + [EXPLICIT, written(ion_plan())]
META_END = EXPLICIT.index(b"\x08\x00\x16\x00UI")
META = EXPLICIT[:META_END]
OPEN = 0xFFFFFFFF
SEQUENCE_HEAD, ITEM_HEAD = b"\x0a\x30\xb0\x00SQ\0\0", b"\xfe\xff\x00\xe0"
ITEM_END, SEQUENCE_END = b"\xfe\xff\x0d\xe0\0\0\0\0", b"\xfe\xff\xdd\xe0\0\0\0\0"


def tried(content: bytes) -> RtPlan | PlanError:
    """Read it; whatever else than a plan or a refusal comes of it fails the test."""
    try:
        return read_plan(content)
    except PlanError as error:
        return error


@pytest.mark.parametrize("content", FILES)
def test_a_file_cut_off_anywhere_is_refused_or_lacks_its_approval(content):
    """DICOM has no end mark: cut between two elements, a file looks whole. What is behind the cut is missed."""
    whole = read_plan(content)
    for length in range(len(content)):
        found = tried(content[:length])
        if isinstance(found, RtPlan):
            assert found == whole or any("not approved" in note for note in found.notes)
        else:
            assert found.bound


@pytest.mark.parametrize("content", FILES)
def test_any_bit_that_flips_gives_a_plan_or_a_refusal(content):
    for at in range(128, len(content)):
        for bit in range(8) if content is EXPLICIT else (at % 8, 7):
            tried(content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :])


@settings(max_examples=300, deadline=None)
@given(st.data(), st.sampled_from(FILES))
def test_whatever_is_cut_out_doubled_or_put_in_gives_a_plan_or_a_refusal(data, content):
    for _ in range(data.draw(st.integers(1, 4))):
        begin = data.draw(st.integers(128, len(content)))
        end = data.draw(st.integers(begin, min(len(content), begin + 64)))
        middle = data.draw(
            st.sampled_from([b"", content[begin:end] * 2, b"\xff\xff\xff\xff", b"\0\0\0\0"]) | st.binary(max_size=16)
        )
        content = content[:begin] + middle + content[end:]
    tried(content)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300))
@example(b"")
def test_any_bytes_behind_a_good_begin_give_a_refusal(rest):
    refused(META + rest)
    refused(rest)


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"\xff\xd8\xff\xe0" + b"x" * 500, "JPEG"),
        (b"\x89PNG\r\n" + b"x" * 500, "PNG"),
        (b"PK\x03\x04" + b"x" * 500, "ZIP"),
        (b'{"plan": 1}', "JSON"),
        (b"<?xml version='1.0'?>", "XML"),
        (b"%PDF-1.7", "PDF"),
        (b"", "no bytes"),
    ],
)
def test_what_is_sent_by_mistake_is_named(content, kind):
    error = refused(content)
    assert (error.code, error.field) == ("plan_not_dicom", "body")
    assert kind in str(error.value)


def test_a_data_set_without_its_file_is_refused():
    assert refused(EXPLICIT[META_END:]).code == "plan_not_dicom"


def test_a_syntax_of_pictures_is_refused_by_its_name():
    jpeg = "1.2.840.10008.1.2.4.50"
    error = refused(written(photon_plan(), TransferSyntaxUID=jpeg))
    assert (error.code, error.value) == ("plan_not_dicom", jpeg)


def element(tag: int, kind: bytes, value: bytes) -> bytes:
    return struct.pack("<HH", tag >> 16, tag & 0xFFFF) + kind + struct.pack("<H", len(value)) + value


def nested(depth: int) -> bytes:
    """Beams in beams in beams, as deep as asked, none of them saying how long it is."""
    level = SEQUENCE_HEAD + struct.pack("<I", OPEN) + ITEM_HEAD + struct.pack("<I", OPEN)
    return META + level * depth + (ITEM_END + SEQUENCE_END) * depth


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 1_000, 100_000])
def test_sequences_without_end_inside_each_other_are_refused_at_the_bound(depth):
    error = refused(nested(depth))
    assert error.code == "plan_too_complex"
    assert str(MAX_DEPTH) in str(error.bound)


def test_sequences_as_deep_as_the_bound_are_not_what_is_wrong():
    assert refused(nested(MAX_DEPTH)).code != "plan_too_complex"


@pytest.mark.parametrize("items", [MAX_ITEMS, MAX_ITEMS + 1])
def test_items_are_bounded(items):
    content = META + SEQUENCE_HEAD + struct.pack("<I", OPEN) + (ITEM_HEAD + b"\0\0\0\0") * items + SEQUENCE_END
    assert (refused(content).code == "plan_too_complex") == (items > MAX_ITEMS)


def test_elements_are_bounded_wherever_they_are(monkeypatch):
    monkeypatch.setattr(part10, "MAX_ITEMS", 10**9)
    many = META + SEQUENCE_HEAD + struct.pack("<I", OPEN) + (ITEM_HEAD + b"\0\0\0\0") * (MAX_ELEMENTS + 1)
    error = refused(many)
    assert (error.code, str(MAX_ELEMENTS) in str(error.bound)) == ("plan_too_complex", True)


def test_a_value_that_is_read_is_bounded():
    assert refused(META + element(0x00100020, b"LO", b"x" * 1024)).code == "plan_invalid"
    assert refused(META + element(0x00100020, b"LO", b"x" * 1026)).code == "plan_too_complex"


def test_beams_of_more_energies_than_any_are_refused():
    plan = photon_plan(BeamSequence=[beam(energies=tuple(float(one) for one in range(1, 514)))])
    assert "512 energies" in str(refused(written(plan)).bound)


@pytest.mark.parametrize("lost", [2, 3, 10, 60])
def test_a_deflated_plan_that_is_cut_off_is_refused_as_cut_off(lost):
    error = refused(written(photon_plan(), "deflated")[:-lost])
    assert (error.code, error.field) == ("plan_truncated", "body")


def test_a_bomb_is_refused_before_it_is_large():
    deflating = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    bomb = b"".join(deflating.compress(b"\0" * 2**20) for _ in range(96)) + deflating.flush()
    content = written(photon_plan(), "deflated")
    begin = content.index(b"1.2.840.10008.1.2.1.99") + 22
    assert len(bomb) < 2**21
    tracemalloc.start()
    error = refused(content[:begin] + bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (error.code, error.field) == ("plan_too_complex", "body")
    assert peak < 3 * MAX_INFLATED_BYTES


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (element(0x00100020, b"LO", b"P1") * 2, "plan_not_dicom"),
        (element(0x00100020, b"LO", b"P1") + element(0x00080060, b"CS", b"CT"), "plan_not_dicom"),
        (element(0x00100020, b"ZZ", b"P1"), "plan_not_dicom"),
        (element(0x00100020, b"IS", b"12"), "plan_not_dicom"),
        (b"\x10\x00\x20\x00UN\0\0" + b"\xff" * 4, "plan_not_dicom"),
        (b"\x10\x00\x20\x00LO\xff\xff" + b"P1", "plan_truncated"),
        (b"\xe0\x7f\x10\x00OB\0\0" + b"\xff" * 4 + ITEM_HEAD + b"\0\0\0\0" + SEQUENCE_END, "plan_not_dicom"),
        (ITEM_END, "plan_not_dicom"),
        (SEQUENCE_HEAD + struct.pack("<I", 8) + ITEM_HEAD + struct.pack("<I", 9), "plan_truncated"),
        (SEQUENCE_HEAD + struct.pack("<I", 8) + element(0x00080060, b"CS", b""), "plan_not_dicom"),
        (SEQUENCE_HEAD + struct.pack("<I", 4) + b"\0" * 4, "plan_truncated"),
        (SEQUENCE_HEAD + struct.pack("<I", OPEN), "plan_truncated"),
        (SEQUENCE_HEAD + struct.pack("<I", 8) + ITEM_HEAD + struct.pack("<I", OPEN), "plan_truncated"),
        (SEQUENCE_HEAD + struct.pack("<I", OPEN) + ITEM_HEAD + struct.pack("<I", OPEN), "plan_truncated"),
        (b"\x0a\x30\x10\x00SQ\0\0" + struct.pack("<I", OPEN), "plan_truncated"),
    ],
    ids=[
        "twice", "out of order", "no such representation", "another representation", "no end", "longer than the file",
        "picture", "stray delimiter", "item longer than its sequence", "element for an item", "half an item",
        "open sequence", "open item in a sequence that ends", "open item", "open sequence that is not wanted",
    ],
)  # fmt: skip
def test_what_is_not_written_as_dicom_is_refused(content, code):
    assert refused(META + content).code == code
