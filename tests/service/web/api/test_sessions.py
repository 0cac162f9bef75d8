"""Creating, listing and reading sessions."""

import pytest

from tests.support.service.api_calls import OPERATOR, act, audit_rows, make_session_body

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]

URL = "/api/v1/sessions"


def changed(body, path, value):
    """Copy a body with one dotted place changed, or removed when the value is `...`."""
    *parents, last = path.split(".")
    copy = {key: dict(part) if isinstance(part, dict) else part for key, part in body.items()}
    place = copy
    for parent in parents:
        place = place[parent]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return copy


def test_a_session_is_created_as_asked(client, session_body):
    answer = client.post(URL, json=session_body)
    assert answer.status_code == 201
    session = answer.json()
    assert session["status"] == "created"
    assert session["is_simulated_beam"] is True
    assert {name: session[name] for name in session_body if name not in {"window"}} == {
        name: session_body[name] for name in session_body if name not in {"window"}
    }
    shown = {name: value for name, value in session["window"].items() if value not in (None, [])}
    assert shown == {**session_body["window"], "kind": "amplitude", "join": "and"}
    assert session["created_at"].endswith("Z")
    assert client.get(f"{URL}/{session['id']}").json()["patient_reference"] == "P-0001"


BAD_BODIES = [
    ("patient_reference", ..., "patient_reference"),
    ("patient_reference", "", "patient_reference"),
    ("patient_reference", "   ", "patient_reference"),
    ("patient_reference", "x" * 81, "patient_reference"),
    ("patient_reference", "a\nb", "patient_reference"),
    ("patient_reference", "a\x00b", "patient_reference"),
    ("patient_reference", 7, "patient_reference"),
    ("operator", None, "operator"),
    ("plan_id", "\u202e", "plan_id"),
    ("fraction_number", 0, "fraction_number"),
    ("fraction_number", 201, "fraction_number"),
    ("fraction_number", 1.5, "fraction_number"),
    ("fraction_number", "3", "fraction_number"),
    ("calibration_id", "nothex", "calibration_id"),
    ("calibration_id", "../../etc/passwd", "calibration_id"),
    ("surprise", 1, "surprise"),
    ("source", {"kind": "magic"}, "source"),
    ("source", {}, "source"),
    ("source.path", "x" * 1025, "source.path"),
    ("source.player", "vlc", "source.player"),
    ("source.speed", 2, "source.speed"),
    ("source.path", "../outside.oni", "source.path"),
    ("source.path", "/etc/passwd", "source.path"),
    ("source.path", "absent.oni", "source.path"),
    ("source.path", f"{'x' * 300}.oni", "source.path"),
    ("source.path", ".", "source.path"),
    ("window", ..., "window"),
    ("window.signal", "heart", "window.signal"),
    ("window.lower_mm", -100.1, "window.lower_mm"),
    ("window.upper_mm", 1e9, "window.upper_mm"),
    ("window.upper_mm", "3", "window.upper_mm"),
    ("window.upper_mm", -1.0, "window.lower_mm"),
    ("window.lower_mm", 5.0, "window.lower_mm"),
    ("window.hysteresis_mm", 2.0, "window.hysteresis_mm"),
    ("window.hysteresis_mm", -0.1, "window.hysteresis_mm"),
    ("window.dwell_ms", -1.0, "window.dwell_ms"),
    ("window.dwell_ms", 10_001, "window.dwell_ms"),
    ("window.row", 1, "window.row"),
    ("window.signal", "region", "window.row"),
    ("window.extra", 1, "window.extra"),
]


def test_a_bad_body_is_refused_with_its_field_and_changes_nothing(client, session_body, subtests):
    for path, value, field in BAD_BODIES:
        with subtests.test(f"{path}: {str(value)[:24]}"):
            answer = client.post(URL, json=changed(session_body, path, value))
            assert answer.status_code in {404, 422}
            problem = answer.json()
            assert answer.headers["content-type"] == "application/problem+json"
            assert problem["field"] == field
            assert problem["code"] in {"invalid_value", "not_found"}
            assert problem["value"]
            assert problem["bound"]
    assert client.get(URL).json()["items"] == []
    refusals = [(row["outcome"], row["detail"]["field"]) for row in audit_rows(client, "session.create")]
    assert refusals == [("refused", field) for _, _, field in BAD_BODIES]


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_a_window_that_is_no_number_is_refused(client, session_body, text):
    body = client.build_request("POST", URL, json=session_body).content.replace(
        b'"upper_mm":3.0', b'"upper_mm":' + text.encode()
    )
    assert text.encode() in body
    answer = client.post(URL, content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert answer.json()["field"] == "window.upper_mm"


def test_a_region_window_names_its_cell(client, session_body):
    session_body["window"] |= {"signal": "region", "row": 13, "column": 7}
    assert client.post(URL, json=session_body).status_code == 201


def test_a_link_out_of_the_allowed_folders_is_not_followed(client, session_body, settings, tmp_path):
    outside = tmp_path / "outside.oni"
    outside.write_bytes(b"secret")
    (settings.recordings_dirs[0] / "link.oni").symlink_to(outside)
    session_body["source"]["path"] = "link.oni"
    answer = client.post(URL, json=session_body)
    assert (answer.status_code, answer.json()["field"]) == (422, "source.path")


def test_an_unknown_calibration_is_not_found(client, session_body):
    session_body["calibration_id"] = "f" * 32
    answer = client.post(URL, json=session_body)
    assert (answer.status_code, answer.json()["field"]) == (404, "calibration_id")


def test_only_one_session_is_open_at_a_time(client, session_body):
    first = client.post(URL, json=session_body).json()["id"]
    second = client.post(URL, json=session_body)
    assert second.status_code == 409
    assert second.json()["code"] == "session_active"
    assert first in second.json()["value"]
    assert act(client, first, "stop").json()["status"] == "stopped"
    assert client.post(URL, json=session_body).status_code == 201


def test_sessions_are_listed_newest_first_page_by_page(client, calibration_id):
    made = []
    for number in range(1, 6):
        body = make_session_body(calibration_id) | {"fraction_number": number}
        made.append(client.post(URL, json=body).json()["id"])
        act(client, made[-1], "stop")
    seen, cursor, pages = [], None, 0
    while pages == 0 or cursor is not None:
        page = client.get(URL, params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
        seen += [item["id"] for item in page["items"]]
        cursor, pages = page["next_cursor"], pages + 1
    assert seen == made[::-1]
    assert pages == 3


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({"limit": 0}, "limit"),
        ({"limit": 501}, "limit"),
        ({"limit": "many"}, "limit"),
        ({"cursor": "nonsense"}, "cursor"),
        ({"cursor": "2026-01-01T00:00:00_x"}, "cursor"),
        ({"cursor": "x" * 81}, "cursor"),
    ],
    ids=str,
)
def test_a_bad_page_is_refused(client, query, field):
    answer = client.get(URL, params=query)
    assert (answer.status_code, answer.json()["field"]) == (422, field)


def test_the_same_key_and_body_give_the_same_session_once(client, session_body):
    headers = {"Idempotency-Key": "try-1"}
    first = client.post(URL, json=session_body, headers=headers)
    again = client.post(URL, json=session_body, headers=headers)
    assert again.status_code == 201
    assert again.json() == first.json()
    assert again.headers["Idempotency-Replayed"] == "true"
    assert len(client.get(URL).json()["items"]) == 1


def test_the_same_key_with_another_body_is_refused(client, session_body):
    headers = {"Idempotency-Key": "try-1"}
    client.post(URL, json=session_body, headers=headers)
    answer = client.post(URL, json=session_body | {"plan_id": "OTHER"}, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (409, "idempotency_key_reused")


def test_a_refused_call_does_not_use_its_key_up(client, session_body):
    headers = {"Idempotency-Key": "try-1"}
    first = client.post(URL, json=session_body).json()["id"]
    assert client.post(URL, json=session_body, headers=headers).status_code == 409
    act(client, first, "stop")
    assert client.post(URL, json=session_body, headers=headers).status_code == 201


@pytest.mark.parametrize("key", ["", "a b", "x" * 256, "caf\xe9"])
def test_a_bad_key_is_refused(client, session_body, key):
    answer = client.post(URL, json=session_body, headers=[("Idempotency-Key", key.encode("latin-1"))])
    assert (answer.status_code, answer.json()["field"]) == (422, "idempotency-key")


@pytest.mark.parametrize("path", ["", "/samples", "/picture", "/transitions", "/models"])
def test_an_unknown_session_is_not_found(client, path):
    answer = client.get(f"{URL}/{'0' * 32}{path}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("action", ["start", "arm", "disarm", "reference", "acknowledge", "stop", "models/retrain"])
def test_an_unknown_session_cannot_be_acted_on(client, action):
    answer = act(client, "0" * 32, action)
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")


def test_no_route_changes_a_session_s_settings(client, session_id):
    for method in ("PUT", "PATCH", "DELETE"):
        answer = client.request(method, f"{URL}/{session_id}", json=OPERATOR)
        assert (answer.status_code, answer.json()["code"]) == (405, "method_not_allowed")
