"""All processes of a run share one learned session."""

import pytest

from verification.faults import template
from verification.faults.operator import PersonGaveUpError
from verification.faults.rig import Template

pytestmark = pytest.mark.waiting


@pytest.fixture
def learned_into(monkeypatch):
    """Replace the learning by an empty folder; the first attempt fails."""
    folders = []

    def learned(folder):
        folders.append(folder)
        folder.mkdir(parents=True)
        if len(folders) == 1:
            raise PersonGaveUpError("nothing was learned")
        return Template(folder=folder, calibration_id="c", model_id="m")

    monkeypatch.setattr(template, "learned", learned)
    return folders


def test_one_process_learns_and_what_failed_is_learned_again(tmp_path, learned_into):
    with pytest.raises(PersonGaveUpError):
        template.learned_once(tmp_path / "learned")
    first, second = (template.learned_once(tmp_path / "learned") for _ in range(2))
    assert first == second == Template(folder=tmp_path / "learned" / "template", calibration_id="c", model_id="m")
    assert len(learned_into) == 2
