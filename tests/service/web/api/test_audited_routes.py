"""No route changes anything, or hands anything out, without a row that says so."""

import pytest

from service.access.request.rules import TAKES_PERMISSION_AWAY
from tests.support.documents.audit_routes import DOCUMENT, EXPORTS, MADE, NOT_AUDITED, UNSAFE, audited, operations
from tests.support.generated_sections import part_of
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import audit_rows

PLACES = dict.fromkeys(("session_id", "plan_id", "model_id", "run_id", "key_id", "login_id", "screen_id"), "0" * 32) | {
    "name": "nobody"
}
WITHOUT_A_CALLER = {("POST", "/api/v1/login"), ("POST", "/api/v1/coach/pair")}


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    from service.core.settings.settings import Settings
    from service.web.app import create_app
    from tests.support.service.fake_engine import FakeEngine

    settings = Settings(data_dir=tmp_path_factory.mktemp("data"), allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings, lambda _settings: FakeEngine())) as client:
        yield client


def test_every_route_that_changes_something_is_named_after_its_action():
    names = {place: action for place, action in audited().items() if place[0] != "GET"}
    assert [place for place, action in names.items() if "." not in action] == []
    assert len(names) > 20


def test_every_export_is_a_route():
    assert {("GET", path) for path in EXPORTS} <= set(operations())
    assert set(NOT_AUDITED) <= set(operations())


def test_every_call_that_is_refused_where_it_would_have_changed_something_is_written_down(client):
    asked = [place for place in audited() if place[0].lower() in UNSAFE and place not in WITHOUT_A_CALLER]
    for method, path in asked:
        answer = client.request(method, path.format(**PLACES), content=b"x", headers={"Content-Type": "text/plain"})
        refused = {404} if (method, path) in TAKES_PERMISSION_AWAY else {401, 403, 415, 422}  # by what it says: never
        assert answer.status_code in refused, (method, path, answer.text)
    body = [row["action"] for row in audit_rows(client) if row["outcome"] == "refused"]
    assert body == [audited()[place] for place in asked]


def test_the_document_states_what_the_routes_do():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert {name: part_of(text, name) for name in MADE} == {name: make() for name, make in MADE.items()}
