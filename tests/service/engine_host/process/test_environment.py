"""The engine process gets no setting by its environment but the form of the frame path, read when it is imported."""

import pytest

from service.engine_host.process.messages import _environment

pytestmark = pytest.mark.waiting


def test_only_the_form_of_the_frame_path_is_handed_on(monkeypatch):
    monkeypatch.setenv("TIDEGATE_FRAME_PATH", "numpy")
    monkeypatch.setenv("TIDEGATE_DATABASE_URL", "postgresql://user:secret@host/db")
    given = {name: value for name, value in _environment().items() if name.startswith("TIDEGATE_")}
    assert given == {"TIDEGATE_FRAME_PATH": "numpy"}
