"""The room's name stands on everything that leaves the room, and cookies of two rooms do not meet."""

import json
import logging

import pytest
from starlette.datastructures import Headers
from starlette.responses import Response

from service.access.login.cookies import CookieScope, set_login_cookie, token_in
from service.core.logging.redaction import formatter
from service.core.settings.settings import Settings, SettingsError, load_settings
from tests.support.service.metrics import read

ROOM = "Linac-2"


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"room": ROOM})


@pytest.mark.parametrize("name", ["2", "Linac-2", "a" * 32, ""])
def test_a_room_is_named_by_letters_digits_and_dashes(monkeypatch, name):
    monkeypatch.setenv("TIDEGATE_ROOM", name)
    assert load_settings().room == name


@pytest.mark.parametrize("name", ["a" * 33, "-2", "Linac 2", "Linac_2", "Räume", "2;", "2\n", "a=b"])
def test_another_name_is_refused(monkeypatch, name):
    monkeypatch.setenv("TIDEGATE_ROOM", name)
    with pytest.raises(SettingsError, match="TIDEGATE_ROOM"):
        load_settings()


def test_stream_metrics_and_audit_have_the_name(client):
    with client.websocket_connect("/api/v1/live") as live:
        assert live.receive_json()["room"] == ROOM
    assert read(client)["tidegate_room_info", ROOM] == 1.0
    rows = client.get("/api/v1/audit", params={"limit": 200}).json()["items"]
    (start,) = [row for row in rows if row["action"] == "service.start"]
    assert start["detail"]["settings"]["room"] == ROOM


def test_a_line_of_the_log_has_the_name():
    record = logging.LogRecord("service", logging.INFO, "", 0, "a line", (), None)
    assert json.loads(formatter("json", room=ROOM).format(record))["room"] == ROOM
    assert "room" not in json.loads(formatter("json").format(record))


@pytest.mark.parametrize("is_secure", [False, True])
def test_a_log_in_at_one_room_is_none_at_another_under_the_same_host_name(is_secure):
    """Browsers send the cookies of one host to each of its ports."""
    rooms = [CookieScope(is_secure=is_secure, room=room) for room in ("", "1", "2")]
    sent = []
    for scope in rooms:
        answer = Response()
        set_login_cookie(answer, f"token-{scope.room}", scope)
        sent.append(answer.headers["set-cookie"].partition(";")[0])
    assert len({one.partition("=")[0] for one in sent}) == 3
    headers = Headers({"Cookie": "; ".join(sent)})
    assert [token_in(headers, scope) for scope in rooms] == ["token-", "token-1", "token-2"]
    assert token_in(Headers({"Cookie": sent[1]}), rooms[2]) is None


def test_a_person_is_logged_in_with_the_cookie_of_the_room(client):
    mine = client.get("/api/v1/me")
    assert mine.status_code == 200
    assert f"tidegate_login_{ROOM}=" in mine.request.headers["cookie"]
