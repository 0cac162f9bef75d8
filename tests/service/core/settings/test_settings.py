"""Settings: read once, bounded, and nothing mistyped goes unnoticed."""

import os
import subprocess
import sys

import pytest
from pydantic import ValidationError

from engine.gating.limits import LIMIT_BOUNDS, GateLimits
from engine.gating.windows import amplitude_window
from service.core.schemas import sessions
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.site_limits.window_limits import gate_limits
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import WINDOW, make_session_body
from tests.support.site_settings import give_settings

pytestmark = pytest.mark.usefixtures("no_settings_around")


def test_without_settings_the_service_listens_on_this_machine_only():
    settings = load_settings()
    assert (settings.host, settings.port, settings.is_remote, settings.is_secure) == ("127.0.0.1", 8000, False, False)
    assert "*" not in settings.host_names


@pytest.mark.parametrize("name", ["TIDEGATE_PROT", "TIDEGATE_", "tidegate_lease", "TIDEGATE_DATA"])
def test_an_unknown_setting_is_refused_by_name(monkeypatch, name):
    monkeypatch.setenv(name, "1")
    with pytest.raises(SettingsError, match=f"^{name} is not a setting"):
        load_settings()


NUMBERS = [name for name, field in Settings.model_fields.items() if field.annotation in {int, float}]


@pytest.mark.parametrize("value", ["-1000000000000", "1000000000000", "nan", "inf", "many", ""])
def test_every_number_has_a_bound(monkeypatch, tmp_path, value):
    """All at once: each is refused in a line of its own."""
    names = {setting_name(name) for name in NUMBERS}
    give_settings(monkeypatch, tmp_path, **dict.fromkeys(NUMBERS, value))
    with pytest.raises(SettingsError) as refusal:
        load_settings()
    refused = {line.partition(":")[0] for line in str(refusal.value).splitlines()}
    assert names - refused == set()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "gating.example", ""])
def test_listening_beyond_this_machine_has_to_be_asked_for(monkeypatch, host):
    with pytest.raises(SettingsError):
        load_settings(host=host)
    monkeypatch.setenv("TIDEGATE_BEHIND_PROXY", "true")
    if host:
        assert load_settings(host=host).host_names == ("*",)
    monkeypatch.delenv("TIDEGATE_BEHIND_PROXY")
    monkeypatch.setenv("TIDEGATE_TLS_CERT", "cert.pem")
    with pytest.raises(SettingsError, match="TIDEGATE_TLS_KEY must be given together"):
        load_settings(host=host or "0.0.0.0")
    monkeypatch.setenv("TIDEGATE_TLS_KEY", "key.pem")
    if host:
        assert load_settings(host=host).is_secure


def test_the_removed_setting_for_open_access_names_its_replacement(monkeypatch):
    monkeypatch.setenv("TIDEGATE_ALLOW_REMOTE", "true")
    with pytest.raises(SettingsError, match=r"ALLOW_REMOTE was removed.*TLS_CERT.*BEHIND_PROXY"):
        load_settings()


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"TRUSTED_PROXIES": "10.0.0.1"}, "without TIDEGATE_BEHIND_PROXY"),
        ({"TRUSTED_PROXIES": "proxy.example", "BEHIND_PROXY": "1"}, "must be an address or a network"),
        ({"TRUSTED_PROXIES": ",".join(["10.0.0.1"] * 17), "BEHIND_PROXY": "1"}, "at most 16"),
        ({"BEHIND_PROXY": "1", "TLS_CERT": "a", "TLS_KEY": "b"}, "a proxy terminates TLS"),
    ],
    ids=str,
)
def test_what_states_two_things_about_the_way_here_is_refused(monkeypatch, environment, said):
    for name, value in environment.items():
        monkeypatch.setenv(f"TIDEGATE_{name}", value)
    with pytest.raises(SettingsError, match=said):
        load_settings()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_loopback_addresses_need_no_permission(host):
    assert load_settings(host=host).host == host


def test_settings_are_frozen_and_lists_are_split(monkeypatch, tmp_path):
    monkeypatch.setenv("TIDEGATE_RECORDINGS_DIRS", f"{tmp_path}/a:{tmp_path}/b")
    monkeypatch.setenv("TIDEGATE_ALLOWED_HOSTS", "one.example, two.example")
    settings = load_settings()
    assert settings.recording_folders == (tmp_path / "a", tmp_path / "b")
    assert settings.host_names == ("one.example", "two.example")
    with pytest.raises(ValidationError):
        settings.port = 1


def test_every_gate_limit_of_the_engine_can_be_set_by_a_site_and_reaches_the_gate():
    window = sessions.Window.model_validate(WINDOW)
    for name in LIMIT_BOUNDS.keys() - {"dwell_ms"}:
        low, high = LIMIT_BOUNDS[name]
        value = type(getattr(Settings(), name))((low + high) / 2)
        others = {"max_silence_ms": 2000.0} if name == "max_gap_ms" else {}
        limits = gate_limits(window, Settings(**{name: value, **others}))
        assert getattr(limits, name) == value
    assert gate_limits(window, Settings()).dwell_ms == WINDOW["dwell_ms"]
    engine_defaults = GateLimits(
        window=amplitude_window(lower_mm=-1.0, upper_mm=3.0, hysteresis_mm=0.2), dwell_ms=200.0
    )
    assert gate_limits(window, Settings()) == engine_defaults


@pytest.mark.parametrize(
    ("site", "field"),
    [
        ({"window_lower_mm": 0.0}, "window.lower_mm"),
        ({"window_upper_mm": 2.9}, "window.upper_mm"),
        ({"min_dwell_ms": 201.0}, "window.dwell_ms"),
    ],
    ids=str,
)
def test_a_session_cannot_widen_a_site_s_limit(settings, engine, calibration_text, site, field):

    from service.web.app import create_app
    from tests.support.service.api_calls import upload

    narrow = settings.model_copy(update=site)
    with PeopleClient(create_app(narrow, lambda _settings: engine)) as client:
        calibration_id = upload(client, calibration_text).json()["id"]
        answer = client.post("/api/v1/sessions", json=make_session_body(calibration_id))
    assert (answer.status_code, answer.json()["field"]) == (422, field)
    assert "this site's limit" in answer.json()["bound"]


@pytest.mark.parametrize(
    ("site", "said"),
    [
        ({"warn_latency_ms": 500.0, "max_latency_ms": 100.0}, "TIDEGATE_MAX_LATENCY_MS is 100"),
        ({"max_silence_ms": 99.0, "max_gap_ms": 100.0}, "TIDEGATE_MAX_SILENCE_MS is 99"),
        ({"camera_latency_ms": 300.0, "max_latency_ms": 300.0}, "TIDEGATE_CAMERA_LATENCY_MS is 300: must be less than"),
        ({"operator_timeout_s": 0.01}, "TIDEGATE_OPERATOR_TIMEOUT_S is 0.01: must be 0"),
        ({"operator_timeout_s": 2.9}, "TIDEGATE_OPERATOR_TIMEOUT_S is 2.9"),
        ({"max_silence_ms": 80.0, "max_frame_age_ms": 81.0}, "TIDEGATE_MAX_SILENCE_MS is 80: must be at least"),
        ({"lease_ms": 20.0}, "TIDEGATE_LEASE_MS is 20: must be at least 50.0, one frame's time at gate.min_fps"),
        ({"max_gap_ms": 60.0, "min_fps": 16.0}, "TIDEGATE_MAX_GAP_MS is 60: must be at least 62.5"),
        ({"watchdog_ms": 80.0}, "TIDEGATE_WATCHDOG_MS is 80: must be more than TIDEGATE_LEASE_MS .80"),
    ],
    ids=str,
)
def test_limits_that_contradict_each_other_are_refused_by_name_where_they_are_read(monkeypatch, tmp_path, site, said):
    give_settings(monkeypatch, tmp_path, **site)
    with pytest.raises(SettingsError, match=said):
        load_settings()


@pytest.mark.parametrize(
    "site",
    [
        {"operator_timeout_s": 0.0},
        {"operator_timeout_s": 3.0},
        {"camera_latency_ms": 299.0, "max_latency_ms": 300.0},
        {"max_silence_ms": 80.0, "max_frame_age_ms": 80.0},
        {"watchdog_ms": 81.0},
        {"lease_ms": 40.0, "max_gap_ms": 40.0, "min_fps": 25.0},
    ],
    ids=str,
)
def test_limits_that_just_go_together_are_taken(site):
    assert all(getattr(Settings(**site), name) == value for name, value in site.items())


@pytest.mark.parametrize(
    ("environment", "said"),
    [({"TIDEGATE_PROT": "1"}, "TIDEGATE_PROT"), ({"TIDEGATE_HOST": "0.0.0.0"}, "TIDEGATE_TLS_CERT")],
    ids=str,
)
def test_the_command_line_states_it_in_one_line_and_ends_with_2(environment, said):
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "serve"],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    started, *refusal = done.stderr.strip().splitlines()
    assert started.endswith("starting")
    assert len(refusal) == 1
    assert said in refusal[0]
