"""The site's file: sections of known keys, overridden by some variables, refused by name."""

import tomllib

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.core.settings.config_file import ENVIRONMENT_ONLY
from service.core.settings.names import CONFIG, OVERRIDES, PREFIX, place_of, setting_name
from service.core.settings.qa import CHOSEN
from service.core.settings.settings import Settings, SettingsError, load_settings

MOST_OVERRIDES = 60


@pytest.fixture
def site(monkeypatch, tmp_path):
    def write(text):
        path = tmp_path / "tidegate.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        monkeypatch.setenv(CONFIG, str(path))
        return path

    return write


def test_every_setting_has_a_place_of_its_own_and_few_are_variables():
    assert len({place_of(name) for name in Settings.model_fields}) == len(Settings.model_fields)
    assert set(Settings.model_fields) >= OVERRIDES
    assert len(OVERRIDES) <= MOST_OVERRIDES
    assert (setting_name("lease_ms"), setting_name("beam_rtu_parity")) == ("TIDEGATE_LEASE_MS", "beam.rtu_parity")


def test_the_file_s_values_are_the_settings_and_a_variable_counts_more(site, monkeypatch):
    site(
        """
        gate = { max_jump_mm = 5, lease_ms = 70, holding_events = ["bradypnea"] }
        [web]
        allowed_hosts = ["a.example", "b.example"]
        [training]
        min_cycles = 4
        [oidc]
        issuer = "https://provider.example"
        machine_audience = "gating"
        machine_scopes = ["gating.read=sessions.read"]
        """.replace("bradypnea", next(iter(sorted(Settings().holding_events))))
    )
    monkeypatch.setenv("TIDEGATE_LEASE_MS", "90")
    found = load_settings()
    assert (found.max_jump_mm, found.lease_ms, found.training.min_cycles) == (5.0, 90.0, 4)
    assert found.allowed_hosts == ("a.example", "b.example")
    assert len(found.holding_events) == 1
    assert list(found.permissions_of_scope) == ["gating.read"]
    assert load_settings(port=1234).port == 1234


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[gate]\nmax_gpa_ms = 3", r"gate.max_gpa_ms is not a setting of Tidegate: perhaps gate.max_gap_ms"),
        ("[gate]\nport = 3", "gate.port is not a setting of Tidegate: perhaps web.port"),
        ("[http]\nheader_s = 10", "http.header_s .*: limits of connections are no settings any more: remove"),
        ("[training]\ncomponents = 4", "training.components .*: it is a constant now: remove the line"),
        ("[qa]\ncamera_distance_warn = 2", "qa.camera_distance_warn .*perhaps .*qa.camera_distance_mm_warn"),
        ("[qa]\nplate_noise_mm_warn = true", "qa.plate_noise_mm_warn is true: must be no truth value"),
        ("[qa]\nbounds_chosen = {}", "qa.bounds_chosen is not a setting"),
        ("[gaet]\nmax_jump_mm = 3", "gaet.max_jump_mm is not a setting of Tidegate: perhaps gate.max_jump_mm"),
        ("port = 3", "port stands outside a section: perhaps web.port"),
        ("[site]\nframe_path = 'numpy'", "site.frame_path .*: it is read from TIDEGATE_FRAME_PATH only"),
        ("[gate]\nmax_jump_mm = 500", "gate.max_jump_mm: .*less than or equal to 20"),
        ("[gate]\nmax_jump_mm = nan", "gate.max_jump_mm: "),
        ("[gate]\nmax_jump_mm = true", "gate.max_jump_mm is true: must be no truth value"),
        ("[gate]\nmax_jump_mm = [5]", "gate.max_jump_mm: "),
        ("[gate]\nmax_jump_mm = 1979-05-27", "gate.max_jump_mm: "),
        ("[gate]\nmax_jump_mm = 5\nmax_jump_mm = 6", "is no TOML"),
        ("[gate", "is no TOML"),
        (b"[gate]\n# \xff", "is no TOML"),
        ("#" * 1_000_001, "more than 1000000 bytes"),
    ],
)
def test_what_cannot_be_meant_is_refused_by_name(site, text, said):
    site(text)
    with pytest.raises(SettingsError, match=said):
        load_settings()


def test_all_that_is_wrong_is_named_at_once(site):
    path = site("[gate]\na = 1\nb = 2\n[web]\nc = 3")
    with pytest.raises(SettingsError) as refusal:
        load_settings()
    lines = str(refusal.value).splitlines()
    assert [line.split()[1] for line in lines] == ["gate.a", "gate.b", "web.c"]
    assert all(line.startswith(f"{path}: ") for line in lines)


def test_a_file_that_is_not_there_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv(CONFIG, str(tmp_path / "none.toml"))
    with pytest.raises(SettingsError, match=r"none.toml \(TIDEGATE_CONFIG\) cannot be read: No such file"):
        load_settings()


@pytest.mark.parametrize("name", sorted(set(Settings.model_fields) - OVERRIDES - {CHOSEN}))
def test_what_no_variable_overrides_is_refused_there_with_its_place(monkeypatch, name):
    monkeypatch.setenv(f"{PREFIX}{name.upper()}", "1")
    with pytest.raises(SettingsError, match=f"write {'.'.join(place_of(name))} into the file that TIDEGATE_CONFIG"):
        load_settings()


def test_a_bound_of_qa_is_no_variable_either(monkeypatch):
    monkeypatch.setenv("TIDEGATE_QA_PLATE_NOISE_MM_WARN", "1")
    with pytest.raises(SettingsError, match=r"write qa.plate_noise_mm_warn into the file"):
        load_settings()


def shown(*arguments):
    ran = CliRunner().invoke(app, ["config", "show", *arguments])
    return ran.exit_code, ran.stdout, ran.stderr


def test_every_setting_is_shown_with_its_source_and_the_text_is_such_a_file(site, monkeypatch, tmp_path):
    path = site("[gate]\nmax_jump_mm = 5\n[beam]\nline = 'simulated'\n[qa]\nplate_noise_mm_warn = 1.25")
    monkeypatch.setenv("TIDEGATE_LEASE_MS", "90")
    code, text, _ = shown("--data", str(tmp_path))
    assert code == 0
    for name in set(Settings.model_fields) - ENVIRONMENT_ONLY - {CHOSEN}:
        section, key = place_of(name)
        part = text.partition(f"[{section}]\n")[2].partition("\n[")[0]
        assert any(line.removeprefix("# ").startswith(f"{key} ") for line in part.splitlines()), name
    sources = {line.split(" =")[0]: line.rpartition("# ")[2] for line in text.splitlines() if " = " in line}
    assert (sources["max_jump_mm"], sources["lease_ms"], sources["data_dir"]) == (
        str(path),
        "environment",
        "command line",
    )
    again = tomllib.loads(text)
    assert (again["gate"], again["qa"]) == ({"lease_ms": 90.0, "max_jump_mm": 5.0}, {"plate_noise_mm_warn": 1.25})
    site(text)
    monkeypatch.delenv("TIDEGATE_LEASE_MS")
    assert load_settings(data_dir=tmp_path).lease_ms == 90.0


def test_only_what_is_not_at_its_default_is_shown_where_asked(site):
    site("[gate]\nmax_jump_mm = 5")
    assert [line.split()[0] for line in shown("--changed")[1].splitlines()] == ["[gate]", "max_jump_mm"]


def test_no_secret_is_shown(site):
    site("[plans]\npatient = 'hash'\npatient_key = 'UNMISTAKABLE-KEY-0123456789'\n")
    code, text, problem = shown()
    assert "UNMISTAKABLE" not in text + problem, (code, text)


def test_settings_that_cannot_be_used_are_no_traceback(site):
    site("[gate]\nmax_jump_mm = 500")
    code, _, problem = shown()
    assert (code, problem.count("\n")) == (2, 1)
    assert problem.startswith("tidegate config show: gate.max_jump_mm")
