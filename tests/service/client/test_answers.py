"""What the client makes of answers: problems, pages, and what no service of ours would ever say."""

import json
import pickle

import pytest

from service import client as module
from service.client import AnswerError, ProblemError, TidegateClient, UnreachableError, UsageError
from tests.support.client.scripted_server import KEY, cuts, refuses, says, writes

SESSION = "0" * 32


def test_a_problem_reports_code_field_value_bound_and_request_id(client, script):
    read_back = {
        "code": "invalid_value",
        "status": 422,
        "field": "window.lower_mm",
        "value": "-400.0",
        "bound": "at least",
    }
    script.steps = [says({**read_back, "detail": "no", "title": "t", "type": "u"}, 422, X_Request_ID="abc")]
    with pytest.raises(ProblemError) as refused:
        client.create_session({})
    error = refused.value
    assert (error.code, error.status, error.field, error.value, error.bound, error.request_id) == (
        "invalid_value", 422, "window.lower_mm", "-400.0", "at least", "abc"
    )  # fmt: skip
    assert str(pickle.loads(pickle.dumps(error))) == str(error) == "422 invalid_value: no"


def test_what_a_proxy_states_in_its_own_words_is_a_problem_too(client, script):
    script.steps = [lambda handler: handler.answer(413, b"<html>too large</html>", "text/html")]
    with pytest.raises(ProblemError, match="http_413"):
        client.create_session({})


@pytest.mark.parametrize(
    "body",
    [b"", b"[]", b"{", b'"text"', b"\xff\xfe", b"[" * 100_000, b'{"items": []}'],
    ids=["nothing", "list", "torn", "text", "no text", "deep", "a part missing"],
)
def test_an_answer_that_the_contract_does_not_know_is_refused(client, script, body):
    script.steps = [lambda handler: handler.answer(200, body)]
    with pytest.raises(AnswerError):
        list(client.sessions())


def test_an_answer_with_more_than_the_contract_states_is_taken(client, script):
    script.steps = [says({"items": [], "next_cursor": None, "new_in_a_later_version": 1})]
    assert list(client.sessions()) == []


def test_an_answer_beyond_the_bound_is_not_read(client, script, monkeypatch):
    monkeypatch.setattr(module, "MAX_ANSWER_BYTES", 1000)
    script.steps = [lambda handler: handler.answer(200, b" " * 1001)]
    with pytest.raises(AnswerError, match="larger than 1000"):
        client.me()


def test_an_answer_that_is_cut_off_is_asked_for_again_and_never_taken(client, script):
    script.steps = [lambda handler: (handler.answer(200, b'{"items": []', length="40"), cuts(handler))]
    with pytest.raises(UnreachableError):
        client.me()
    assert len(script.requests) == 4


def test_pages_are_walked_to_the_last_and_each_is_asked_for_when_it_is_reached(client, script):
    script.steps = [
        says({"items": [{"id": "a"}, {"id": "b"}], "next_cursor": "next&page"}),
        says({"items": [{"id": "c"}], "next_cursor": None}),
    ]
    found = client.sessions()
    assert next(found)["id"] == "a"
    assert len(script.requests) == 1
    assert [one["id"] for one in found] == ["b", "c"]
    assert script.requests[1].path == "/api/v1/sessions?cursor=next%26page"


def test_a_list_that_leads_round_in_a_circle_ends(client, script):
    script.steps = [says({"items": [], "next_cursor": "again"})]
    with pytest.raises(AnswerError, match="same cursor twice"):
        list(client.sessions())
    assert [one.path for one in script.requests] == ["/api/v1/sessions", "/api/v1/sessions?cursor=again"]


def test_an_export_is_the_whole_file_or_none(client, script, tmp_path):
    there = tmp_path / "samples.csv"
    there.write_text("of before")
    chunk = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
    torn = [
        chunk + b"5\r\nframe\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\nframe_index",
        b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\nframe_index",
    ]
    script.steps = [writes(torn[0])]
    with pytest.raises(UnreachableError):
        client.export_samples(SESSION, there)
    script.steps = [writes(torn[1])]
    with pytest.raises(UnreachableError):
        client.export_samples(SESSION, there)
    script.steps = [writes(torn[2])]
    with pytest.raises(AnswerError, match="complete"):
        client.export_samples(SESSION, there)
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("samples.csv", "of before")]
    script.steps = [writes(torn[0]), writes(chunk + b"5\r\nframe\r\n0\r\n\r\n")]
    assert client.export_samples(SESSION, there).size == 5
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("samples.csv", "frame")]


def test_an_export_beyond_its_bound_leaves_nothing(client, script, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_EXPORT_BYTES", 10)
    script.steps = [lambda handler: handler.answer(200, b"frame_index", "text/csv")]
    with pytest.raises(AnswerError, match="larger than 10"):
        client.export_samples(SESSION, tmp_path / "samples.csv")
    assert list(tmp_path.iterdir()) == []


def test_readiness_is_an_answer_although_something_is_missing(client, script):
    read_back = dict.fromkeys(module.Readiness.__required_keys__) | {"is_ready": False, "not_ready": ["no disk"]}
    script.steps = [says(read_back, 503)]
    assert client.readiness()["not_ready"] == ["no disk"]
    assert len(script.requests) == 1


def test_a_session_is_read_with_its_version_and_a_call_can_insist_on_it(client, script):
    detail = dict.fromkeys(module.SessionDetail.__required_keys__)
    script.steps = [says(detail, ETag='"7"'), refuses(412, "precondition_failed")]
    tagged = client.read_session_tagged(SESSION)
    with pytest.raises(ProblemError, match="precondition_failed"):
        client.arm(SESSION, if_match=tagged.etag)
    assert script.requests[1].headers["if-match"] == '"7"'


def test_ids_are_one_part_of_a_path_whatever_is_in_them(client, script):
    script.steps = [refuses(404, "not_found")]
    with pytest.raises(ProblemError):
        client.read_session("../../users?x=1#y\r\nX: y")
    assert script.requests[0].path == "/api/v1/sessions/..%2F..%2Fusers%3Fx%3D1%23y%0D%0AX%3A%20y"
    for name in ("", ".", ".."):
        with pytest.raises(UsageError):
            client.read_session(name)


def test_the_key_is_sent_and_seen_nowhere_else(client, script):
    script.steps = [refuses(401, "not_logged_in")]
    with pytest.raises(ProblemError) as refused:
        client.me()
    assert script.requests[0].headers["authorization"] == f"Bearer {KEY}"
    assert KEY not in f"{client!r} {refused.value!r} {refused.value}"
    with pytest.raises(UsageError) as unusable:
        TidegateClient("http://localhost:1", key=f"{KEY}\r\nX: y")
    assert KEY not in str(unusable.value)


@pytest.mark.parametrize(
    "address",
    [
        "http://gating.example",
        "http://10.0.0.1:8000",
        "ftp://localhost",
        "https://me:secret@gating.example",
        "https://gating.example?key=1",
        "gating.example",
        "",
    ],
)
def test_an_address_that_would_show_the_key_to_others_is_refused(address):
    with pytest.raises(UsageError):
        TidegateClient(address, key=KEY)


def test_plain_http_to_another_machine_is_somebody_s_own_decision():
    assert "10.0.0.1" in repr(TidegateClient("http://10.0.0.1:8000", key=KEY, is_plain_http_allowed=True))


def test_a_person_who_logged_in_is_known_by_their_cookie_and_the_page_s_origin(script):
    me = dict.fromkeys(module.Me.__required_keys__)
    script.steps = [says(me, Set_Cookie="tidegate=secret; HttpOnly; Path=/"), refuses(409, "engine_refused")]
    with TidegateClient(f"http://127.0.0.1:{script.port}") as client:
        client.log_in("A. Therapist", "a password")
        with pytest.raises(ProblemError):
            client.acknowledge(SESSION)
    assert script.requests[1].headers["cookie"] == "tidegate=secret"
    assert script.requests[1].headers["origin"] == f"http://127.0.0.1:{script.port}"
    assert json.loads(script.requests[0].body) == {"name": "A. Therapist", "password": "a password"}
