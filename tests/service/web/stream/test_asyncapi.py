"""The stream's contract: every message is in it, every reference leads somewhere, every example is what it says."""

import json
from collections.abc import Iterator
from typing import get_args

import pytest

from service.core.schemas.coach_messages import COACH_MESSAGE
from service.core.schemas.live_messages import LIVE_MESSAGE, AnySample, LiveMessage, Message
from service.web.openapi.asyncapi import COACH_MESSAGES, MESSAGES, asyncapi_document
from tests.support.contract.schemas import Schema
from tests.support.repository import ROOT

DOCUMENT = asyncapi_document()
LIVE_SCHEMA = json.loads((ROOT / "openapi" / "live.schema.json").read_text())
COACH_SCHEMA = json.loads((ROOT / "openapi" / "coach.schema.json").read_text())
NAMES = [kind.__name__ for kind in MESSAGES]
COACH_NAMES = [kind.__name__ for kind in COACH_MESSAGES]


def references(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        for key, part in value.items():
            if key == "$ref":
                yield part
            else:
                yield from references(part)
    elif isinstance(value, list):
        for part in value:
            yield from references(part)


def found(reference: str) -> object:
    place: object = DOCUMENT
    for step in reference.removeprefix("#/").split("/"):
        place = place[step]
    return place


def example_of(name: str) -> dict:
    (example,) = DOCUMENT["components"]["messages"][name]["examples"]
    return example["payload"]


def test_every_reference_leads_somewhere():
    named = set(references(DOCUMENT))
    assert len(named) > 20
    for reference in named:
        assert reference.startswith("#/")
        assert found(reference) is not None


def test_it_has_what_an_asyncapi_document_has():
    assert DOCUMENT["asyncapi"] == "3.0.0"
    assert {"title", "version"} <= DOCUMENT["info"].keys()
    assert {one["address"] for one in DOCUMENT["channels"].values()} == {
        "/api/v1/live",
        "/api/v1/live/events",
        "/api/v1/coach/live",
    }
    for operation in DOCUMENT["operations"].values():
        assert operation["action"] == "send"
        assert {reference["$ref"].split("/")[2] for reference in operation["messages"]} == {
            operation["channel"]["$ref"].split("/")[2]
        }


def test_every_message_of_the_stream_is_in_it():
    union = get_args(get_args(LiveMessage)[0])
    kinds = [kind for kind in union if isinstance(kind, type)] + list(get_args(get_args(AnySample)[0]))
    assert all(issubclass(kind, Message) for kind in kinds)
    assert {kind.__name__ for kind in kinds} == set(NAMES)
    assert {*NAMES, *COACH_NAMES} == set(DOCUMENT["components"]["messages"])


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_a_message(name: str):
    example = example_of(name)
    read = LIVE_MESSAGE.validate_python(example)
    assert type(read).__name__ == name
    assert json.loads(read.model_dump_json(exclude_none=name == "Hello")) == example


@pytest.mark.parametrize("name", NAMES)
def test_an_example_keeps_to_both_schemas(name: str):
    example = example_of(name)
    whole = {"$ref": f"#/components/schemas/{name}", "components": DOCUMENT["components"]}
    for schema in (whole, LIVE_SCHEMA):
        validator = Schema(schema)
        validator.validate(example)
        assert not validator.is_valid(example | {"surprise": 1})
        assert not validator.is_valid({key: value for key, value in example.items() if key != "sent_at"})


@pytest.mark.parametrize("name", COACH_NAMES)
def test_an_example_of_the_coaching_stream_keeps_to_its_schemas(name: str):
    example = example_of(name)
    read = COACH_MESSAGE.validate_python(example)
    assert (type(read).__name__, json.loads(read.model_dump_json())) == (name, example)
    for schema in ({"$ref": f"#/components/schemas/{name}", "components": DOCUMENT["components"]}, COACH_SCHEMA):
        validator = Schema(schema)
        validator.validate(example)
        assert not validator.is_valid(example | {"level_mm": 1.0})


def test_all_numbers_of_the_coaching_stream_but_the_age_are_bounded():
    for definition in COACH_SCHEMA["$defs"].values():
        for name, rule in definition["properties"].items():
            for kind in rule.get("anyOf", [rule]):
                if kind.get("type") == "number" and name != "age_ms":
                    assert {"minimum", "maximum"} <= kind.keys(), name


@pytest.mark.parametrize("query", ["LiveQuery", "EventsQuery"])
def test_what_may_be_asked_for_is_bounded(query: str):
    schema = DOCUMENT["components"]["schemas"][query]
    assert schema["additionalProperties"] is False
    for name, rule in schema["properties"].items():
        for kind in rule.get("anyOf", [rule]):
            if kind.get("type") in {"number", "integer"}:
                assert {"minimum", "maximum"} <= kind.keys(), name
