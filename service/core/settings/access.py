"""Settings of access: address, TLS, proxies, and lifetimes of log-ins and API keys."""

import ipaddress
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator
from pydantic_settings import NoDecode

from service.core.settings.names import PREFIX, Env, In, Section

Addresses = Annotated[tuple[str, ...], NoDecode]
NameList = Annotated[tuple[str, ...], NoDecode]
MOST_PROXIES = 16


class AccessSettings(Section):
    """Settings of access; a part of :class:`service.core.settings.settings.Settings`."""

    SECTION = "web"

    port: Env[int] = Field(default=8000, ge=0, le=65535)
    allowed_hosts: Env[NameList] = Field(
        default=(), description="Names accepted in the Host header; default: loopback names"
    )
    allowed_origins: Env[NameList] = Field(
        default=(), description="Origins of other pages that may open the live stream"
    )
    host: Env[str] = Field(default="127.0.0.1", min_length=1, max_length=253)
    tls_cert: Env[Path | None] = Field(default=None, description="The service's certificate chain (PEM)")
    tls_key: Env[Path | None] = Field(default=None, description="The certificate's key")
    behind_proxy: Env[bool] = Field(default=False, description="A reverse proxy in front terminates TLS")
    trusted_proxies: Env[Addresses] = Field(
        default=(),
        max_length=MOST_PROXIES,
        description="Addresses or networks whose X-Forwarded-For is trusted, comma-separated; default: loopback",
    )
    login_hours: Annotated[float, In("access")] = Field(default=12.0, ge=0.25, le=24.0, description="Longest log-in")
    login_idle_min: Annotated[float, In("access")] = Field(
        default=30.0, ge=1.0, le=720.0, description="A log-in ends after this time without a request"
    )
    key_max_days: Annotated[int, In("access")] = Field(
        default=365, ge=1, le=1825, description="Longest lifetime of an API key"
    )

    @field_validator("trusted_proxies", "allowed_hosts", "allowed_origins", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("trusted_proxies")
    @classmethod
    def _are_networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for text in value:
            try:
                ipaddress.ip_network(text)
            except ValueError as error:
                msg = f"{text!r} must be an address or a network as in 10.0.0.0/24"
                raise ValueError(msg) from error
        return value

    @model_validator(mode="after")
    def _is_encrypted(self) -> Self:
        if (self.tls_cert is None) != (self.tls_key is None):
            msg = f"{PREFIX}TLS_CERT and {PREFIX}TLS_KEY must be given together"
            raise ValueError(msg)
        if self.has_tls and self.behind_proxy:
            msg = f"{PREFIX}BEHIND_PROXY means that a proxy terminates TLS: leave out {PREFIX}TLS_CERT, or it"
            raise ValueError(msg)
        if self.trusted_proxies and not self.behind_proxy:
            msg = f"{PREFIX}TRUSTED_PROXIES must be left out without {PREFIX}BEHIND_PROXY=true"
            raise ValueError(msg)
        if not (self.has_tls or self.behind_proxy or is_loopback(self.host)):
            msg = (
                f"host {self.host} can be reached over the network, where passwords must be encrypted: set "
                f"{PREFIX}TLS_CERT and {PREFIX}TLS_KEY, or {PREFIX}BEHIND_PROXY=true if a proxy in front terminates TLS"
            )
            raise ValueError(msg)
        return self

    @property
    def has_tls(self) -> bool:
        """Whether the service itself terminates TLS."""
        return self.tls_cert is not None

    @property
    def is_secure(self) -> bool:
        """Whether browsers connect by https, so that cookies can be ``Secure``."""
        return self.has_tls or self.behind_proxy

    @property
    def is_remote(self) -> bool:
        """Whether other machines can connect."""
        return self.behind_proxy or not is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Whether an address is loopback."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
