"""Files that are complete or absent: what a failure, an earlier attempt and a reader in between find."""

import os
import stat

import pytest

from engine.core.files import open_plain, put_in_place, remove, whole_file, write_whole


def names_in(folder):
    return [path.name for path in folder.iterdir()]


def test_a_file_keeps_its_content_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "plan.json"
    write_whole(path, b"old")
    with whole_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert names_in(tmp_path) == ["plan.json"]


@pytest.mark.parametrize("is_durable", [False, True])
def test_what_fails_leaves_the_old_file_and_no_other(tmp_path, is_durable):
    path = tmp_path / "plan.json"
    write_whole(path, b"old", is_durable=is_durable)

    def fail(file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_whole(path, fail, is_durable=is_durable)
    assert path.read_bytes() == b"old"
    assert names_in(tmp_path) == ["plan.json"]


def test_the_rest_of_a_killed_attempt_is_replaced(tmp_path):
    (tmp_path / "plan.json.partial").write_bytes(b"much longer than the new content")
    write_whole(tmp_path / "plan.json", lambda file: file.write(b"new"))
    assert (tmp_path / "plan.json").read_bytes() == b"new"
    assert names_in(tmp_path) == ["plan.json"]


def test_a_private_file_is_private_before_it_holds_anything(tmp_path):
    with whole_file(tmp_path / "key", mode=0o600, is_durable=True) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600


def test_a_durable_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    synced, path = [], tmp_path / "model.npz"
    really = os.fsync

    def noted(number):
        synced.append((stat.S_ISDIR(os.fstat(number).st_mode), path.exists()))
        really(number)

    monkeypatch.setattr(os, "fsync", noted)
    write_whole(path, b"content", is_durable=True)
    assert synced == [(False, False), (True, True)]
    remove(path)
    remove(path)
    assert synced[2:] == [(True, False)] * 2


def test_put_in_place_replaces_the_file_of_that_name(tmp_path):
    (tmp_path / "a").write_bytes(b"old")
    (tmp_path / "b").write_bytes(b"new")
    put_in_place(tmp_path / "b", tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == b"new"
    assert names_in(tmp_path) == ["a"]


def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="no plain file"):
        open_plain(tmp_path / "pipe")
