"""Nothing that was promised to other software is taken away: the contract is held against those that were released."""

import json
from copy import deepcopy

import pytest

from tests.support.contract.breaking_changes import broken
from tests.support.repository import ROOT

pytestmark = pytest.mark.slow

FOLDER = ROOT / "openapi"
NOW = json.loads((FOLDER / "openapi.json").read_text(encoding="utf-8"))
RELEASED = sorted((FOLDER / "released").glob("*.json"))
SESSIONS = "/api/v1/sessions"


def schema(document, name):
    return document["components"]["schemas"][name]


def test_nothing_breaks_what_was_written_against_a_release():
    """Compatibility begins with 1.0.0; the present contract stands for the one that will be released."""
    contracts = [NOW, *(json.loads(file.read_text(encoding="utf-8")) for file in RELEASED)]
    assert [broken(contract, NOW) for contract in contracts] == [[]] * len(contracts)


def _drop(name, field):
    return lambda new: schema(new, name)["properties"].pop(field)


def _set(name, field, **changes):
    return lambda new: schema(new, name)["properties"][field].update(changes)


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda new: new["paths"].pop(SESSIONS), "POST /api/v1/sessions is gone"),
        (lambda new: new["paths"][SESSIONS].pop("get"), "GET /api/v1/sessions is gone"),
        (_drop("Session", "plan_id"), "201.plan_id is gone"),
        (_drop("SessionRequest", "plan_id"), "body.plan_id is not taken"),
        (lambda new: schema(new, "SessionRequest")["required"].append("model_id"), "body.model_id is required"),
        (lambda new: schema(new, "Session")["required"].remove("plan_id"), "201.plan_id may be missing"),
        (lambda new: schema(new, "Session")["properties"]["status"]["enum"].remove("ended"), "'ended' is gone"),
        (_set("Window", "dwell_ms", maximum=5_000.0), "dwell_ms: maximum is 5000.0, was 10000.0"),
        (_set("Window", "dwell_ms", minimum=1.0), "dwell_ms: minimum is 1.0"),
        (_set("SessionRequest", "plan_id", maxLength=8), "plan_id: maxLength is 8"),
        (_set("SessionRequest", "plan_id", pattern="^A$"), "plan_id: pattern is ^A$"),
        (_set("Session", "plan_id", type=["string", "null"]), "plan_id may be null"),
        (lambda new: new["paths"][SESSIONS]["post"]["responses"].pop("201"), "201 is never answered"),
        (lambda new: new["paths"][SESSIONS]["get"]["parameters"].clear(), "parameter limit is gone"),
    ],
)
def test_what_breaks_is_noticed_and_named(change, reported):
    new = deepcopy(NOW)
    change(new)
    assert any(reported in one for one in broken(NOW, new)), broken(NOW, new)


@pytest.mark.parametrize(
    "change",
    [
        _set("Window", "dwell_ms", maximum=50_000.0),
        _set("Window", "dwell_ms", description="other words"),
        lambda new: schema(new, "Session")["properties"].update(more={"type": "string"}),
        lambda new: schema(new, "SessionRequest")["properties"].update(more={"type": "string"}),
        lambda new: new["paths"].update({"/api/v1/more": {"get": {"responses": {}}}}),
        lambda new: schema(new, "SessionRequest")["required"].remove("plan_id"),
    ],
)
def test_what_adds_or_lets_more_breaks_nothing(change):
    new = deepcopy(NOW)
    change(new)
    assert broken(NOW, new) == []
