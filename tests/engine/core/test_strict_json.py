"""What an unknown caller's JSON gets wrong is reported by field, value and bound, in the caller's error."""

import pytest

from engine.core.errors import InvalidValueError, ModelError
from engine.core.strict_json import ROOT, StrictJson

READ = StrictJson(max_bytes=100, max_nesting=3)


class OwnError(InvalidValueError):
    code = "own"


def refusal_of(call, *arguments, **named):
    with pytest.raises(InvalidValueError) as refusal:
        call(*arguments, **named)
    return refusal.value


def test_each_reader_raises_its_own_error():
    with pytest.raises(OwnError) as refusal:
        StrictJson(error=OwnError).parse(b"")
    assert not isinstance(refusal.value, ModelError)
    assert refusal.value.field == ROOT


@pytest.mark.parametrize(
    ("text", "bound"),
    [
        (b" " * 101, "at most 100 bytes"),
        (b"[[[[]]]]", "nested at most 3 deep"),
        (b'{"a": 1, "a": 1}', "given once"),
        (b'{"a": NaN}', "made of finite numbers"),
        (b'{"a": -Infinity}', "made of finite numbers"),
        (b'{"a": 1e999}', "made of finite numbers"),
        (b'{"a": -1e999}', "made of finite numbers"),
        (b'{"\\ud800": 1}', "a JSON document"),
        (b'["\\uDFFF"]', "a JSON document"),
        (b"\xff", "a JSON document"),
        (b"{", "a JSON document"),
    ],
)
def test_a_document_is_bounded(text, bound):
    assert refusal_of(READ.parse, text).bound.startswith(bound)


def test_a_character_of_two_halves_is_whole_and_a_long_number_costs_nothing():
    assert READ.parse(b'["\\ud83d\\ude00"]') == ["\U0001f600"]
    digits = StrictJson(max_bytes=10_000)
    assert refusal_of(digits.parse, b"9" * 5000).bound.startswith("a JSON document")
    assert digits.parse(b"9" * 4000) == 10**4000 - 1


def test_a_file_is_never_read_beyond_its_bound(tmp_path):
    path = tmp_path / "large.json"
    path.write_bytes(b" " * 100_000)
    assert len(READ.read_bytes(path)) == 101
    assert refusal_of(READ.load, path).bound == "at most 100 bytes"
    assert "missing.json" in refusal_of(READ.load, tmp_path / "missing.json").value


def test_keys_are_named_with_the_path_to_them():
    taken = READ.fields("a.b", {"x": 1}, required=("x",), optional=("y",))
    assert taken["x"] == 1
    assert refusal_of(READ.fields, "a.b", {"x": 1, "z": 1}, required=("x",)).field == "a.b.z"
    assert refusal_of(READ.fields, ROOT, {}, required=("x",)).field == "x"
    assert refusal_of(READ.fields, "a", [], required=()).bound == "a JSON object"


def test_values_keep_to_their_kind_and_bound():
    assert READ.number("n", 3, 0.0, 3.0) == 3.0
    assert READ.integer("n", 3, 0, 3) == 3
    assert READ.vector("v", [1, 2.5], 2, 0.0, 3.0) == [1.0, 2.5]
    assert READ.items("l", [1], 1, 2) == [1]
    assert READ.name("t", "abc") == "abc"
    for call, *arguments in (
        (READ.number, "n", True, 0, 3),
        (READ.number, "n", "3", 0, 3),
        (READ.number, "n", float("nan"), 0, 3),
        (READ.number, "n", 10**400, 0, 3),
        (READ.integer, "n", 3.0, 0, 3),
        (READ.integer, "n", False, 0, 3),
        (READ.items, "l", [], 1, 2),
        (READ.items, "l", "ab", 1, 2),
        (READ.name, "t", ""),
        (READ.name, "t", "a\tb"),
    ):
        assert refusal_of(call, *arguments).field == arguments[0]
    assert refusal_of(READ.vector, "v", [1, 9], 2, 0.0, 3.0).field == "v[1]"
