"""The list of recordings: what a session may play, described, and what it may not play, with the reason."""

import os

import pytest

from engine.capture.oni.writer import OniWriter
from tests.support.capture.oni_recordings import PERIOD_US, depth_picture, write_recording

URL = "/api/v1/recordings"


@pytest.fixture
def folder(settings):
    """The site's folder, without the fake engine's file."""
    (found,) = settings.recordings_dirs
    (found / "chest.oni").unlink()
    return found


def listed(client, **query):
    answer = client.get(URL, params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def paths(client, **query):
    return [one["path"] for one in listed(client, **query)["items"]]


def test_a_site_without_recordings_has_an_empty_list(client, folder):
    assert listed(client) == {"items": [], "next_cursor": None}


def test_a_recording_is_described_by_its_first_records_and_its_path_is_that_of_a_session(client, folder, session_body):
    file = write_recording(folder / "chest.oni", frames=31)
    (item,) = listed(client)["items"]
    assert item["modified_at"].startswith("20")
    assert item["seconds"] == pytest.approx(30 * PERIOD_US / 1e6, abs=0.02)
    expected = {"path": "chest.oni", "bytes": file.stat().st_size, "width_px": 64, "height_px": 48, "fps": 30}
    assert {name: item[name] for name in expected} == expected
    assert (item["has_color"], item["problem"]) == (True, None)
    session_body["source"]["path"] = item["path"]
    assert client.post("/api/v1/sessions", json=session_body).status_code == 201


def test_a_recording_without_colour_states_it(client, folder):
    with OniWriter(folder / "depth.oni", depth_size=(64, 48), color_size=None) as writer:
        writer.write_depth(0, depth_picture(0), frame_id=1)
    (item,) = listed(client)["items"]
    assert (item["has_color"], item["problem"]) == (False, None)


def test_what_cannot_be_played_is_listed_with_the_reason(client, folder, tmp_path):
    (folder / "empty.oni").touch()
    (folder / "pointer.oni").write_bytes(b"version https://git-lfs.github.com/spec/v1\n" + bytes(100))
    outside = write_recording(tmp_path / "outside.oni")
    (folder / "leads_out.oni").symlink_to(outside)
    (folder / "leads_nowhere.oni").symlink_to(folder / "gone.oni")
    reasons = {item["path"]: item["problem"] for item in listed(client)["items"]}
    assert "Git LFS" in reasons["pointer.oni"]
    assert "inside one of the allowed folders" in reasons["leads_out.oni"]
    assert "no such recording" in reasons["leads_nowhere.oni"]
    assert reasons["empty.oni"]
    assert all(item["bytes"] is None for item in listed(client)["items"])


def test_a_name_that_no_request_can_contain_is_left_out(client, folder):
    (folder / os.fsdecode(b"\xff.oni")).touch()
    write_recording(folder / "Übung ☃.oni", frames=2)
    assert paths(client) == ["Übung ☃.oni"]


def test_pages_lead_through_all_folders_though_files_are_added_meanwhile(client, folder):
    for number in (1, 3, 5, 7):
        sub = folder / ("x" * 200) / f"day {number}"
        sub.mkdir(parents=True)
        (sub / "a.oni").touch()
    page = listed(client, limit=2)
    seen = [item["path"] for item in page["items"]]
    (folder / ("x" * 200) / "day 3" / "b.oni").touch()
    (folder / "a.oni").touch()
    while page["next_cursor"] is not None:
        page = listed(client, limit=2, cursor=page["next_cursor"])
        seen += [item["path"] for item in page["items"]]
    assert seen == [f"{'x' * 200}/day {name}.oni" for name in ("1/a", "3/a", "3/b", "5/a", "7/a")]


def test_a_page_after_a_recording_that_was_removed_is_refused(client, folder):
    for name in "abc":
        (folder / f"{name}.oni").touch()
    cursor = listed(client, limit=1)["next_cursor"]
    (folder / "a.oni").unlink()
    answer = client.get(URL, params={"cursor": cursor})
    assert (answer.status_code, answer.json()["field"]) == (422, "cursor")
    assert "first page" in answer.json()["detail"]
