"""Settings of the hospital's log-in (OpenID Connect): the provider, and the rights of its groups and scopes.

An incomplete provider is refused, because log-in there would not work.
"""

import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator
from pydantic_settings import NoDecode

from service.core.permissions import KEY_PERMISSIONS, Permission, Role
from service.core.settings.access import is_loopback
from service.core.settings.names import Env, Section, setting_name

RETURN_PATH = "/api/v1/login/oidc/return"
MAX_ADDRESS = 500
MAX_WORD = 200
MAX_ENTRIES = 100
MAX_SECRET_BYTES = 4_096
Words = Annotated[tuple[str, ...], NoDecode]
GroupRoles = Annotated[tuple[tuple[str, Role], ...], NoDecode]
ScopePermissions = Annotated[tuple[tuple[str, Permission], ...], NoDecode]
LocalAccounts = Literal["break-glass", "all"]

PEOPLE = ("oidc_client_id", "oidc_redirect_uri", "oidc_group_roles")
MACHINES = ("oidc_machine_audience", "oidc_machine_scopes")


class OidcSettings(Section):
    """Settings of the provider; a part of :class:`service.core.settings.settings.Settings`."""

    SECTION = "oidc"
    KEY_PREFIX = "oidc_"

    oidc_issuer: Env[str] = Field(
        default="", max_length=MAX_ADDRESS, description="The provider, exactly as in its tokens' iss"
    )
    oidc_client_id: Env[str] = Field(
        default="", max_length=MAX_WORD, description="This service's client id at the provider"
    )
    oidc_client_secret_file: Env[Path | None] = Field(
        default=None, description="A file with the client secret; without it the client is public (PKCE)"
    )
    oidc_ca_file: Env[Path | None] = Field(default=None, description="CA certificates (PEM) for the provider")
    oidc_redirect_uri: Env[str] = Field(
        default="", max_length=MAX_ADDRESS, description=f"Redirect URI: https://NAME{RETURN_PATH}"
    )
    oidc_scopes: Words = Field(default=("openid", "profile"), max_length=20, description="Comma-separated")
    oidc_name_claim: str = Field(
        default="name", min_length=1, max_length=MAX_WORD, description="Claim with the name for the audit"
    )
    oidc_groups_claim: str = Field(default="groups", min_length=1, max_length=MAX_WORD)
    oidc_group_roles: GroupRoles = Field(
        default=(),
        max_length=MAX_ENTRIES,
        description="group=role, comma-separated; a person without a role is refused",
    )
    oidc_label: str = Field(
        default="the hospital's log-in", min_length=1, max_length=40, description="Label of the button"
    )
    oidc_local_accounts: LocalAccounts = Field(
        default="break-glass", description="Local accounts that may still log in by password"
    )
    oidc_machine_audience: str = Field(
        default="", max_length=MAX_ADDRESS, description="The aud of machines' access tokens"
    )
    oidc_machine_scope_claim: str = Field(default="scope", min_length=1, max_length=MAX_WORD)
    oidc_machine_scopes: ScopePermissions = Field(
        default=(), max_length=MAX_ENTRIES, description="scope=permission, comma-separated"
    )
    oidc_machine_types: Words = Field(
        default=("at+jwt",), min_length=1, max_length=5, description="The typ of machines' access tokens"
    )
    oidc_max_clock_skew_s: int = Field(default=30, ge=0, le=300)

    @field_validator("oidc_scopes", "oidc_machine_types", mode="before")
    @classmethod
    def _split_words(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("oidc_group_roles", "oidc_machine_scopes", mode="before")
    @classmethod
    def _split_pairs(cls, value: object) -> object:
        parts = [part for part in value.split(",") if part.strip()] if isinstance(value, str) else value
        if not isinstance(parts, list | tuple):
            return value
        return tuple(_pair(part.strip()) if isinstance(part, str) else part for part in parts)

    @field_validator("oidc_machine_types")
    @classmethod
    def _are_types(cls, types: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(one.lower().removeprefix("application/") for one in types)

    @field_validator("oidc_machine_scopes")
    @classmethod
    def _are_for_machines(cls, scopes: tuple[tuple[str, Permission], ...]) -> tuple[tuple[str, Permission], ...]:
        for scope, permission in scopes:
            if permission not in KEY_PERMISSIONS:
                msg = f"{scope}={permission}: not available to machines; one of {', '.join(sorted(KEY_PERMISSIONS))}"
                raise ValueError(msg)
        return scopes

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if not self.oidc_issuer:
            given = sorted(name for name in self.model_fields_set if name.startswith("oidc_"))
            if given:
                msg = f"{setting_name(given[0])} is set, but {setting_name('oidc_issuer')} is not"
                raise ValueError(msg)
            return self
        self._check_addresses()
        for part in (PEOPLE, MACHINES):
            self._refuse_incomplete(part)
        if not self.has_oidc_people and not self.has_oidc_machines:
            msg = f"{setting_name('oidc_issuer')} is set, but neither {_names(PEOPLE)} nor {_names(MACHINES)} are"
            raise ValueError(msg)
        self._refuse_ambiguous()
        return self

    @property
    def has_oidc_people(self) -> bool:
        """Whether people log in at the provider."""
        return bool(self.oidc_issuer and self.oidc_client_id)

    @property
    def has_oidc_machines(self) -> bool:
        """Whether machines authenticate with the provider's tokens."""
        return bool(self.oidc_issuer and self.oidc_machine_audience)

    @property
    def roles_of_group(self) -> Mapping[str, frozenset[Role]]:
        """Roles of each of the provider's groups."""
        groups = {group for group, _ in self.oidc_group_roles}
        return {one: frozenset(role for group, role in self.oidc_group_roles if group == one) for one in groups}

    @property
    def permissions_of_scope(self) -> Mapping[str, frozenset[Permission]]:
        """Permissions of each of the provider's scopes."""
        scopes = {scope for scope, _ in self.oidc_machine_scopes}
        return {one: frozenset(done for scope, done in self.oidc_machine_scopes if scope == one) for one in scopes}

    def oidc_client_secret(self) -> str | None:
        """Read the client's secret; the message of an error does not contain it.

        Raises
        ------
        ValueError
            The file cannot be read, is empty or has more than one line.
        """
        if self.oidc_client_secret_file is None:
            return None
        name = setting_name("oidc_client_secret_file")
        try:
            content = self.oidc_client_secret_file.read_bytes()[: MAX_SECRET_BYTES + 1].decode().strip()
        except (OSError, UnicodeDecodeError) as error:
            msg = f"{name}: {self.oidc_client_secret_file} cannot be read as text: {type(error).__name__}"
            raise ValueError(msg) from None
        if not 0 < len(content) <= MAX_SECRET_BYTES or not content.isprintable():
            msg = f"{name}: {self.oidc_client_secret_file} must hold one line of 1 to {MAX_SECRET_BYTES} characters"
            raise ValueError(msg)
        return content

    def _check_addresses(self) -> None:
        if not is_safe_address(self.oidc_issuer):
            msg = (
                f"{setting_name('oidc_issuer')} must be https://host[/path] (http only on this machine), without ? or #"
            )
            raise ValueError(msg)
        redirect = self.oidc_redirect_uri
        if redirect and not (is_safe_address(redirect) and urlsplit(redirect).path == RETURN_PATH):
            msg = f"{setting_name('oidc_redirect_uri')} must be https://NAME{RETURN_PATH} (http only on this machine)"
            raise ValueError(msg)
        self.oidc_client_secret()
        if self.oidc_ca_file is not None:
            _check_certificates(self.oidc_ca_file)

    def _refuse_incomplete(self, part: tuple[str, ...]) -> None:
        given = [name for name in part if getattr(self, name)]
        if given and len(given) < len(part):
            missing = next(name for name in part if name not in given)
            msg = f"{setting_name(given[0])} is set, but {setting_name(missing)} is not"
            raise ValueError(msg)

    def _refuse_ambiguous(self) -> None:
        if self.oidc_client_id and self.oidc_client_id == self.oidc_machine_audience:
            msg = (
                f"{setting_name('oidc_machine_audience')} must differ from {setting_name('oidc_client_id')}: "
                "otherwise the ID token of a log-in would be accepted by the API"
            )
            raise ValueError(msg)
        if self.has_oidc_people and "openid" not in self.oidc_scopes:
            msg = f"{setting_name('oidc_scopes')} must hold openid"
            raise ValueError(msg)
        if not self.oidc_label.isprintable():
            msg = f"{setting_name('oidc_label')} must be printable characters"
            raise ValueError(msg)


def _check_certificates(path: Path) -> None:
    try:
        ssl.create_default_context(cafile=path)
    except OSError as error:  # ssl's own errors are among them
        msg = f"{setting_name('oidc_ca_file')}: {path} holds no certificates that can be read ({type(error).__name__})"
        raise ValueError(msg) from error


def is_safe_address(address: str) -> bool:
    """Whether the connection there is protected: https, or loopback."""
    try:
        parts = urlsplit(address)
        _ = parts.port
    except ValueError:
        return False
    is_plain = bool(parts.hostname) and parts.username is None and not parts.query and not parts.fragment
    is_clean = address.isascii() and address.isprintable() and not any(sign in address for sign in ' "<>\\')
    if not is_plain or not is_clean or len(address) > MAX_ADDRESS or address.endswith(("?", "#")):
        return False
    return parts.scheme == "https" or (parts.scheme == "http" and is_loopback(parts.hostname or ""))


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.rpartition("=")
    if not equals or not name.strip() or len(text) > MAX_WORD or not text.isprintable():
        msg = f"{text[:80]!r} must be name=value of at most {MAX_WORD} characters"
        raise ValueError(msg)
    return name.strip(), value.strip()


def _names(names: tuple[str, ...]) -> str:
    return " and ".join(setting_name(name) for name in names)
