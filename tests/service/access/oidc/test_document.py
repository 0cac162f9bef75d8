"""docs/3-operate/oidc.md names every setting of the provider."""

from service.core.settings.names import setting_name
from service.core.settings.oidc import OidcSettings
from tests.support.repository import ROOT

PAGE = ROOT / "docs" / "3-operate" / "oidc.md"


def test_the_page_has_a_row_for_every_setting_and_for_nothing_else():
    rows = [
        line.split("`")[1]
        for line in PAGE.read_text().splitlines()
        if line.startswith(("| `TIDEGATE_OIDC", "| `oidc."))
    ]
    assert rows == [setting_name(name) for name in OidcSettings.model_fields]
