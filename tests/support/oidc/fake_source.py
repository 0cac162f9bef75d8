"""A source of provider documents without a network."""

from service.access.oidc.refusals import OidcUnavailableError
from tests.support.oidc.provider_server import Provider as Described
from tests.support.oidc.tokens import ISSUER, KEY, published


class FakeSource:
    """A provider's documents, and how often anyone asked."""

    def __init__(self) -> None:
        self.documents = {
            f"{ISSUER}/.well-known/openid-configuration": Described(issuer=ISSUER)._description(),
            f"{ISSUER}/jwks": published(KEY),
        }
        self.is_down = False
        self.asked = 0

    def get_json(self, address):
        self.asked += 1
        if self.is_down:
            raise OidcUnavailableError("down")
        return self.documents[address]
