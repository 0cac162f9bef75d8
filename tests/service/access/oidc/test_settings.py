"""Half a provider, or one that anyone could listen to, is refused where the settings are read."""

import pytest
from pydantic import ValidationError

from service.core.permissions import Permission, Role
from service.core.settings.oidc import RETURN_PATH, OidcSettings
from service.core.settings.settings import Settings, SettingsError, load_settings
from tests.support.oidc.provider_server import SECRET, Provider
from tests.support.site_settings import give_settings

HTTPS = Provider(issuer="https://provider.example/realms/hospital")


def refused(**given) -> str:
    with pytest.raises(ValidationError) as caught:
        OidcSettings(**given)
    return str(caught.value)


def test_without_any_of_it_there_is_no_provider():
    settings = OidcSettings()
    assert (settings.has_oidc_people, settings.has_oidc_machines) == (False, False)


def test_a_whole_provider_is_taken_as_it_is_written(oidc):
    settings = OidcSettings(**oidc(HTTPS))
    assert settings.roles_of_group == {
        "radiotherapy": {Role.THERAPIST},
        "physics": {Role.PHYSICIST, Role.VIEWER},
        "it": {Role.ADMIN},
    }
    assert settings.permissions_of_scope["tidegate.run"] == {Permission.SESSIONS_RUN}
    assert settings.oidc_client_secret() == SECRET


def test_a_group_may_hold_an_equals_sign(oidc):
    settings = OidcSettings(**oidc(HTTPS, oidc_group_roles="cn=rt=therapist"))
    assert settings.roles_of_group == {"cn=rt": {Role.THERAPIST}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"oidc_issuer": ...}, "OIDC_ISSUER is not"),
        ({"oidc_issuer": "http://provider.example"}, "https"),
        ({"oidc_issuer": "https://user:word@provider.example"}, "https"),
        ({"oidc_issuer": "https://provider.example?x=1"}, "https"),
        ({"oidc_issuer": "https://provider.example/#"}, "https"),
        ({"oidc_issuer": "https://"}, "https"),
        ({"oidc_issuer": "https://provider.example:99999"}, "https"),
        ({"oidc_issuer": "provider.example"}, "https"),
        ({"oidc_client_id": ...}, "OIDC_CLIENT_ID is not"),
        ({"oidc_redirect_uri": ...}, "OIDC_REDIRECT_URI is not"),
        ({"oidc_redirect_uri": f"http://tidegate.example{RETURN_PATH}"}, "REDIRECT_URI must be"),
        ({"oidc_redirect_uri": "https://tidegate.example/elsewhere"}, "REDIRECT_URI must be"),
        ({"oidc_group_roles": ...}, "oidc.group_roles is not"),
        ({"oidc_group_roles": "radiotherapy"}, "name=value"),
        ({"oidc_group_roles": "=therapist"}, "name=value"),
        ({"oidc_group_roles": "radiotherapy=surgeon"}, "viewer"),
        ({"oidc_group_roles": ",".join(f"g{n}=viewer" for n in range(101))}, "at most 100"),
        ({"oidc_machine_audience": ...}, "oidc.machine_audience is not"),
        ({"oidc_machine_scopes": ...}, "oidc.machine_scopes is not"),
        ({"oidc_machine_scopes": "a=gate.acknowledge"}, "not available to machines"),
        ({"oidc_machine_scopes": "a=users.manage"}, "not available to machines"),
        ({"oidc_machine_scopes": "a=qa.run"}, "not available to machines"),
        ({"oidc_machine_scopes": "a=everything"}, "oidc_machine_scopes"),
        ({"oidc_machine_audience": "tidegate"}, "must differ"),
        ({"oidc_scopes": "profile"}, "must hold openid"),
        ({"oidc_label": "a\nb"}, "printable"),
        ({"oidc_max_clock_skew_s": 301}, "300"),
        ({"oidc_local_accounts": "some"}, "break-glass"),
    ],
    ids=str,
)
def test_what_cannot_be_meant_is_refused(oidc, changes, words):
    assert words in refused(**oidc(HTTPS, **changes))


def test_an_issuer_alone_is_refused():
    assert "neither" in refused(oidc_issuer=HTTPS.issuer)


@pytest.mark.parametrize(
    "content", [b"", b" \n", b"two\nlines", b"\xff\xfe", b"x" * 5_000], ids=lambda text: repr(text[:9])
)
def test_a_secret_file_without_a_secret_is_refused_and_its_content_is_not_reported(oidc, secret_file, content):
    secret_file.write_bytes(content)
    reported = refused(**oidc(HTTPS))
    assert "OIDC_CLIENT_SECRET_FILE" in reported
    assert "lines" not in reported.partition("input_value")[0]


def test_a_secret_file_that_is_not_there_is_refused(oidc, tmp_path):
    assert "cannot be read" in refused(**oidc(HTTPS, oidc_client_secret_file=tmp_path / "none"))


def test_certificates_that_cannot_be_read_are_refused(oidc, tmp_path):
    assert "OIDC_CA_FILE" in refused(**oidc(HTTPS, oidc_ca_file=tmp_path / "none"))
    (tmp_path / "odd.pem").write_text("no certificate")
    assert "OIDC_CA_FILE" in refused(**oidc(HTTPS, oidc_ca_file=tmp_path / "odd.pem"))


def test_the_secret_is_in_no_dump_of_the_settings(oidc):
    settings = OidcSettings(**oidc(HTTPS))
    assert SECRET not in settings.model_dump_json() + repr(settings) + str(settings.model_dump())


def test_they_are_settings_of_the_site_read_from_file_and_environment(oidc, monkeypatch, tmp_path):
    give_settings(monkeypatch, tmp_path, **oidc(HTTPS))
    assert load_settings(data_dir=tmp_path).has_oidc_people
    monkeypatch.setenv("TIDEGATE_BEHIND_PROXY", "true")
    with pytest.raises(SettingsError, match="OIDC_REDIRECT_URI must be https"):
        load_settings(data_dir=tmp_path)
    monkeypatch.setenv("TIDEGATE_OIDC_REDIRECT_URI", f"https://tidegate.example{RETURN_PATH}")
    assert load_settings(data_dir=tmp_path).is_secure
    monkeypatch.delenv("TIDEGATE_BEHIND_PROXY")
    with pytest.raises(SettingsError, match="OIDC_REDIRECT_URI must be http,"):
        load_settings(data_dir=tmp_path)
    monkeypatch.delenv("TIDEGATE_OIDC_CLIENT_ID")
    with pytest.raises(SettingsError, match="TIDEGATE_OIDC_CLIENT_ID is not"):
        load_settings(data_dir=tmp_path)
    assert issubclass(Settings, OidcSettings)
