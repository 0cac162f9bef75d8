"""Uploading calibrations: the engine's parser decides, and a refused one changes nothing."""

import json

import pytest

from tests.support.calibration.foreign_calibrations import (
    CAMERAS,
    as_yaml,
    camera_info,
    import_document,
    ros_pair,
    storage_values,
    write_storage,
)
from tests.support.service.api_calls import audit_rows, edited, make_calibration, upload

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]

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


def test_who_uploads_is_who_has_logged_in(client, calibration_text):
    client.speaks_as = "B. Physicist"
    answer = client.post(URL, content=calibration_text, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["uploaded_by"]) == (201, "B. Physicist")


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


def test_opencv_and_ros_files_are_stored_as_ours_and_the_answer_states_what_they_were(client, tmp_path):
    storage = write_storage(
        tmp_path / "a.yml", storage_values(unit_mm=1000.0) | {"camera": "a", "first_camera": "depth"}
    )
    yaml = {"Content-Type": "application/yaml"}
    opencv, ros = upload(client, storage, **yaml), upload(client, b"---\n".join(ros_pair()), **yaml)
    ours = upload(client, make_calibration().to_json())
    assert [answer.status_code for answer in (opencv, ros, ours)] == [201, 201, 201]
    formats = [answer.json()["format"] for answer in (opencv, ros, ours)]
    assert formats == ["opencv-filestorage", "ros-camera-info", "tidegate.calibration/1"]
    assert "metres" in opencv.json()["notes"][0]
    stored = client.get(f"{URL}/{opencv.json()['id']}").json()["document"]
    assert stored["schema"] == "tidegate.calibration/1"
    assert stored["depth_to_color"]["translation_mm"] == pytest.approx([25.0, -0.5, 1.25])
    assert audit_rows(client, "calibration.upload")[0]["detail"]["format"] == "opencv-filestorage"


def test_a_pair_with_what_it_leaves_open_comes_in_one_json_document(client):
    files = [as_yaml(camera_info(CAMERAS.depth, "depth")), as_yaml(camera_info(CAMERAS.color, "rgb"))]
    refused = upload(client, import_document(files))
    assert (refused.status_code, refused.json()["field"]) == (422, "files[1].projection_matrix")
    answer = upload(client, import_document(files, baseline_mm=25.0, camera="bench 7"), **{"Idempotency-Key": "k"})
    assert (answer.status_code, answer.json()["camera"]) == (201, "bench 7")
    again = upload(client, import_document(files, baseline_mm=25.0, camera="bench 7"), **{"Idempotency-Key": "k"})
    assert again.json() == answer.json()


@pytest.mark.parametrize("media_type", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data"])
def test_no_form_of_a_foreign_page_uploads_a_calibration(client, calibration_text, media_type):
    answer = upload(client, calibration_text, **{"Content-Type": media_type})
    assert (answer.status_code, answer.json()["field"]) == (415, "Content-Type")


def test_yaml_is_for_calibrations_only(client, session_body):
    answer = client.post("/api/v1/sessions", content=b"{}", headers={"Content-Type": "application/yaml"})
    assert answer.status_code == 415


@pytest.mark.parametrize(("suffix", "media_type"), [("xml", "application/xml"), ("json", "application/json")])
def test_the_other_flavours_of_opencv_are_taken_too(client, tmp_path, suffix, media_type):
    values = storage_values() | {"camera": "a", "first_camera": "depth"}
    answer = upload(client, write_storage(tmp_path / f"a.{suffix}", values), **{"Content-Type": media_type})
    assert (answer.status_code, answer.json()["format"]) == (201, "opencv-filestorage")
    assert answer.json()["notes"] == []
