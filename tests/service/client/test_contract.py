"""The client cannot drift from the contract: the same calls, names, types and optionality, and nothing forgotten."""

import inspect
import re
import typing

import pytest

from service import client as module
from service.client import ClientError, TidegateClient
from tests.support.client.operations import NOT_FOR_PLANNING, OPERATIONS, contract, is_left_out
from tests.support.client.scripted_server import refuses
from tests.support.contract.document import parameters_of
from tests.support.documents.client_models import CLIENT, formatted, made_part, schema_of, with_made_part

DOCUMENT = contract()
CALLS = {
    (method.upper(), path): operation
    for path, item in DOCUMENT["paths"].items()
    for method, operation in item.items()
    if method in {"get", "post", "put", "patch", "delete"}
}
METHODS = {
    name: method
    for name, method in inspect.getmembers(TidegateClient, inspect.isfunction)
    if not name.startswith("_") and name not in {"close", "live"}
}
ARGUMENTS = {
    "document": b"{}",
    "dicom": b"DICM",
    "request": {},
    "by_mm": 1.0,
    "drift_mm": 1.0,
    "check": "camera_distance_mm",
    "name": "somebody",
    "password": "word",
    "old_password": "old",
    "new_password": "new",
}


def test_the_types_of_answers_and_requests_are_those_of_the_contract():
    text = CLIENT.read_text()
    assert text == formatted(with_made_part(text, made_part())), (
        "run: python -m tests.support.documents.client_models --write"
    )


def test_every_call_of_the_contract_is_offered_or_left_out_on_purpose():
    offered = set(OPERATIONS.values())
    assert {call for call in CALLS if call not in offered and not is_left_out(*call)} == set(contract_calls_elsewhere())
    assert offered <= CALLS.keys()
    assert not [call for call in offered if is_left_out(*call)]
    unneeded = [one for one in NOT_FOR_PLANNING if not any(_is_under(one, call) for call in CALLS)]
    assert unneeded == []


def contract_calls_elsewhere():
    """The live stream has a method and a contract of its own."""
    return [call for call in CALLS if call[1].startswith("/api/v1/live") or call[1].endswith("openapi.json")]


def _is_under(beginning, call):
    return f"{call[0]} {call[1]}".startswith(beginning) or call[1].startswith(beginning)


def test_every_method_is_in_the_table_of_operations():
    assert METHODS.keys() - {"read_session_tagged"} == OPERATIONS.keys()


@pytest.mark.parametrize("name", sorted(OPERATIONS))
def test_a_method_answers_with_the_type_of_its_operation(name):
    schema = schema_of(CALLS[OPERATIONS[name]])
    answer = typing.get_type_hints(METHODS[name], vars(module))["return"]
    (item,) = typing.get_args(answer) or (answer,)
    if schema is None:
        assert answer in {type(None), module.Exported}
    elif schema.endswith("Page"):
        items = typing.get_type_hints(getattr(module, schema))["items"]
        assert typing.get_args(items) == (item,)
    else:
        assert item.__name__ == schema


@pytest.mark.parametrize("name", sorted(OPERATIONS))
def test_a_method_makes_the_call_of_its_operation(name, client, script, tmp_path):
    script.steps = [refuses(404, "not_found")]
    parameters = inspect.signature(METHODS[name]).parameters.values()
    given = {
        one.name: _argument(one.name, tmp_path)
        for one in parameters
        if one.name != "self" and one.default is inspect.Parameter.empty
    }
    with pytest.raises(ClientError):
        list(METHODS[name](client, **given))
    method, template = OPERATIONS[name]
    (request,) = script.requests
    path = request.path.partition("?")[0]
    assert request.method == method
    assert re.fullmatch(re.sub(r"\\{\w+\\}", r"[0-9a-z]+", re.escape(template)), path)
    allowed = {one["name"].lower(): one for one in parameters_of(DOCUMENT, CALLS[method, template])}
    queried = re.findall(r"[?&](\w+)=", request.path)
    assert set(queried) <= {name for name, one in allowed.items() if one["in"] == "query"}
    if "idempotency-key" in {name.lower() for name in allowed} and request.headers.get("idempotency-key") is None:
        assert name in {"log_in"}, "a call that can have a key has one"


IN_OTHER_WORDS = {"cursor", "limit", "format", "with_patients"}
"""What paging and `form` are for; and who exports patients' references is a person's matter."""


@pytest.mark.parametrize("name", sorted(OPERATIONS))
def test_every_parameter_of_a_call_can_be_given(name):
    answer = parameters_of(DOCUMENT, CALLS[OPERATIONS[name]])
    wanted = {one["name"].lower().replace("-", "_"): one for one in answer if one["in"] in {"query", "path", "header"}}
    left_out = {name for name, one in wanted.items() if one["in"] == "header"} - {"if_match", "idempotency_key"}
    given = set(inspect.signature(METHODS[name]).parameters)
    if name in WITHOUT_A_WORD:
        given |= WITHOUT_A_WORD[name]
    assert wanted.keys() - IN_OTHER_WORDS - left_out <= given


WITHOUT_A_WORD = {"upload_calibration": {"idempotency_key"}, "retrain": {"if_match"}, "apply_model": {"if_match"}}
"""The same calibration is the same by its content; a model's calls are refused by state, and never repeated."""


def _argument(name, folder):
    if name == "to":
        return folder / "file"
    return ARGUMENTS.get(name, "0" * 32 if name.endswith("_id") else None)
