"""Uploading calibrations: the engine's parser decides, and a refused one changes nothing."""

import json

import pytest

from tests.service.conftest import audit_rows, edited, make_calibration, upload

URL = "/api/v1/calibrations"


def test_an_uploaded_calibration_can_be_read_back(client, calibration_text):
    answer = upload(client, calibration_text)
    assert answer.status_code == 201
    detail = client.get(f"{URL}/{answer.json()['id']}").json()
    assert detail["document"] == json.loads(calibration_text)
    assert (detail["camera"], detail["uploaded_by"]) == ("test", "A. Physicist")
    assert detail["sha256"] == make_calibration().sha256


def test_the_same_content_is_the_same_calibration(client, calibration_text):
    first = upload(client, calibration_text)
    again = upload(client, json.dumps(json.loads(calibration_text), indent=None))
    assert (again.status_code, again.json()) == (200, first.json())
    assert len(client.get(URL).json()["items"]) == 1


BAD = [
    ("depth.width", 10, "depth.width"),
    ("depth.fx", 1e9, "depth.fx"),
    ("depth.fx", "570", "depth.fx"),
    ("color.cy", -5.0, "color.cy"),
    ("depth_to_color.rotation", [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "depth_to_color.rotation[0][0]"),
    ("depth_to_color.rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "depth_to_color.rotation"),
    ("depth_to_color.translation_mm", [201.0, 0.0, 0.0], "depth_to_color.translation_mm[0]"),
    ("camera", "a\nb", "camera"),
    ("schema", "tidegate.calibration/2", "schema"),
    ("more", 1, "more"),
]


@pytest.mark.parametrize(("path", "value", "field"), BAD, ids=lambda part: str(part)[:30])
def test_a_bad_calibration_is_refused_with_field_value_and_bound(client, calibration_text, path, value, field):
    answer = upload(client, edited(calibration_text, path, value))
    problem = answer.json()
    assert answer.status_code == 422
    assert (problem["code"], problem["field"]) == ("calibration_invalid", field)
    assert problem["value"]
    assert problem["bound"]
    assert client.get(URL).json()["items"] == []
    assert audit_rows(client, "calibration.upload")[-1]["outcome"] == "refused"


@pytest.mark.parametrize(
    "text",
    [b"", b"null", b"[]", b"{", b"\xff\xfe", b'{"a":' * 3000, b"[" * 60_000, b"1" * 60_000, b" " * 65_537],
    ids=["empty", "null", "list", "cut", "not utf-8", "deep objects", "deep lists", "long number", "spaces"],
)
def test_what_is_no_calibration_is_refused(client, text):
    answer = upload(client, text)
    assert answer.status_code in {413, 422}
    assert answer.json()["field"] in {"file", "body"}
    assert client.get(URL).json()["items"] == []


def test_twenty_megabytes_of_nothing_are_refused_by_their_length_alone(client):
    answer = upload(client, b"x", **{"Content-Length": str(20 * 1024 * 1024)})
    assert (answer.status_code, answer.json()["code"], answer.json()["field"]) == (413, "body_too_large", "body")
    assert audit_rows(client, "calibration.upload")[-1]["outcome"] == "refused"


def test_a_stream_without_length_is_cut_off_at_the_bound(client, settings):
    sent = 0

    def endless():
        nonlocal sent
        for _ in range(320):
            sent += 65_536
            yield b" " * 65_536

    answer = upload(client, endless())
    assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")


def test_who_uploads_has_to_be_said(client, calibration_text):
    answer = client.post(URL, content=calibration_text, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["field"]) == (422, "operator")


def test_a_key_gives_the_same_answer_and_refuses_another_body(client, calibration_text):
    headers = {"Idempotency-Key": "k1"}
    first = upload(client, calibration_text, **headers)
    assert upload(client, calibration_text, **headers).json() == first.json()
    other = upload(client, make_calibration("other").to_json(), **headers)
    assert (other.status_code, other.json()["code"]) == (409, "idempotency_key_reused")


def test_calibrations_are_listed_newest_first_page_by_page(client):
    made = [upload(client, make_calibration(f"camera {i}").to_json()).json()["id"] for i in range(3)]
    first = client.get(URL, params={"limit": 2}).json()
    second = client.get(URL, params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert [item["id"] for item in first["items"] + second["items"]] == made[::-1]
    assert second["next_cursor"] is None


def test_an_unknown_calibration_is_not_found(client):
    assert client.get(f"{URL}/{'0' * 32}").status_code == 404
