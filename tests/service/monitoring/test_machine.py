"""The machine's description: settings with their source, and no secret."""

import json

import pytest

from service.core.settings.settings import Settings
from service.monitoring.machine import MachineDescription
from service.storage.audit.check import redacted_settings


@pytest.fixture
def described(tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_ROOM", "Linac-2")
    settings = Settings(data_dir=tmp_path, port=8123, room="Linac-2")
    machine = MachineDescription(settings=settings, readiness=lambda: READY, backup_at=lambda: None).describe()
    return settings, {one.name: one for one in machine.settings}, machine


READY = {"is_ready": True, "not_ready": [], "reasons": [], "warnings": [], "checked_at": "2026-11-24T07:00:00Z"}


def test_every_setting_is_there_with_its_value_as_the_audit_has_it(described):
    settings, found, _ = described
    assert len(found) == len(Settings.model_fields)
    recorded = redacted_settings(settings)
    assert sorted(found[name].value for name in found) == sorted(
        json.dumps(value, ensure_ascii=False) for value in recorded.values()
    )


def test_a_setting_states_where_it_comes_from(described):
    _, found, _ = described
    assert found["TIDEGATE_PORT"].source == "command line", "neither file nor environment has it"
    assert found["TIDEGATE_MAX_FRAME_AGE_MS"].source == "default"


def test_the_disk_is_that_of_the_data_folder(described):
    _, _, machine = described
    assert 0 < machine.disk_free_mb <= machine.disk_total_mb
    assert machine.certificate_ends_at is None
