"""Several recording folders: a path names one file, or is refused with both."""

import pytest

from service.core.errors import BoundError, NotFoundError
from service.engine_host.site_limits.recording_folders import find_recording, refuse_same_names


@pytest.fixture
def folders(tmp_path):
    made = (tmp_path / "a", tmp_path / "b")
    for folder in made:
        (folder / "day 1").mkdir(parents=True)
    return made


def test_a_file_is_found_in_either_folder(folders):
    (folders[0] / "first.oni").touch()
    (folders[1] / "day 1" / "second.oni").touch()
    assert find_recording("first.oni", folders) == folders[0] / "first.oni"
    assert find_recording("day 1/second.oni", folders) == folders[1] / "day 1" / "second.oni"
    refuse_same_names(folders)


def test_the_same_path_in_two_folders_is_refused_with_both_files(folders):
    files = [folder / "day 1" / "chest.oni" for folder in folders]
    for file in files:
        file.touch()
    for refused in (lambda: find_recording("day 1/chest.oni", folders), lambda: refuse_same_names(folders)):
        with pytest.raises(BoundError) as error:
            refused()
        assert all(str(file) in str(error.value) for file in files)


def test_one_file_reached_through_two_folders_is_one_recording(folders):
    (folders[0] / "chest.oni").touch()
    (folders[1] / "chest.oni").symlink_to(folders[0] / "chest.oni")
    assert find_recording("chest.oni", (*folders, folders[0])) == folders[0] / "chest.oni"
    refuse_same_names((*folders, folders[0]))


def test_the_same_name_in_different_subfolders_is_no_duplicate(folders):
    (folders[0] / "chest.oni").touch()
    (folders[1] / "day 1" / "chest.oni").touch()
    refuse_same_names(folders)


def test_a_missing_folder_has_no_duplicates(tmp_path):
    refuse_same_names((tmp_path / "unmounted", tmp_path))
    with pytest.raises(NotFoundError):
        find_recording("chest.oni", (tmp_path / "unmounted", tmp_path))
