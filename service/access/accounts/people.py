"""User accounts: created, changed and disabled, but never deleted, since the audit refers to their names.

Creates the first administrator at the first start, when no account exists to create another.
"""

import secrets
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from service.access.accounts.records import User, check_name, is_like, name_key
from service.access.accounts.store import AccessStore
from service.core.errors import BoundError, LastAdminError, NameTakenError, NotFoundError, OutsideUserError
from service.core.permissions import Role
from service.storage.audit import SYSTEM, Event

ADD = "user.create"
CHANGE = "user.change"
ONE_TIME_BYTES = 15
FIRST_NAME = "admin"
OnFirstAdmin = Callable[[str, str], None]
"""Receives the name and the one-time password, which is not stored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Issued:
    """An account and its new one-time password, to be shown once; None if none was generated. ``repr`` omits it."""

    user: User
    one_time_password: str | None

    def __repr__(self) -> str:
        return f"Issued(user={self.user.name!r})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """The changes to an account; None leaves a field as it is."""

    roles: frozenset[Role] | None = None
    is_disabled: bool | None = None
    is_break_glass: bool | None = None
    reset_password: bool = False


class AccountService:
    """Creates, changes and lists accounts; each change and its audit row are one transaction.

    Parameters
    ----------
    make_hash
        Hashes a password; may raise PasswordServiceBusyError.
    """

    def __init__(self, store: AccessStore, make_hash: Callable[[str], str]) -> None:
        self._store = store
        self._hash = make_hash

    def all(self) -> list[User]:
        """List all accounts, disabled ones too, by name."""
        return sorted(self._store.users.values(), key=lambda user: user.key)

    def get(self, name: str) -> User:
        """Return the account of a name, compared by `name_key`; raise NotFoundError if there is none."""
        user = self._store.users.get(name_key(name))
        if user is None:
            msg = "there is no such person"
            raise NotFoundError(msg, field="name", value=name)
        return user

    def add(
        self,
        name: str,
        roles: Iterable[Role],
        *,
        by: str,
        password: str | None = None,
        is_break_glass: bool = False,
    ) -> Issued:
        """Create an account with the given password, or with a one-time password to be changed at the first log-in.

        Raises
        ------
        BoundError
            The name or the roles are not allowed.
        NameTakenError
            An account has, or had, this name.
        """
        name = check_name(name)
        self._refuse_taken(name)
        one_time = secrets.token_urlsafe(ONE_TIME_BYTES) if password is None else None
        user = User(
            name=name,
            password_hash=self._hash(one_time or password or ""),
            roles=_require_roles(roles),
            must_change_password=one_time is not None,
            is_break_glass=is_break_glass,
            created_at=self._store.now(),
        )
        detail = {"user": name, "roles": sorted(user.roles), "is_break_glass": is_break_glass}
        with self._store.changing:
            self._refuse_taken(name)
            self._store.write(save=[user], event=Event(actor=by, action=ADD, detail=detail))
        return Issued(user=user, one_time_password=one_time)

    def change(
        self, name: str, change: Change, *, by: str, check: Callable[[User], None] = lambda _user: None
    ) -> Issued:
        """Change an account; disabling it or resetting its password ends all its log-ins.

        ``check`` is called under the lock with the account before the change, and may raise.

        Raises
        ------
        NotFoundError
            There is no such account.
        OutsideUserError
            Roles and password are the identity provider's.
        LastAdminError
            No active administrator with a password would be left.
        """
        self._refuse_provider_fields(self.get(name), change)
        one_time = secrets.token_urlsafe(ONE_TIME_BYTES) if change.reset_password else None
        new_hash = None if one_time is None else self._hash(one_time)
        with self._store.changing:
            before = self.get(name)
            check(before)
            after = replace(
                before,
                roles=before.roles if change.roles is None else _require_roles(change.roles),
                is_disabled=before.is_disabled if change.is_disabled is None else change.is_disabled,
                is_break_glass=before.is_break_glass if change.is_break_glass is None else change.is_break_glass,
                password_hash=new_hash or before.password_hash,
                must_change_password=before.must_change_password or one_time is not None,
            )
            self._refuse_no_admin(after)
            ends = after.is_disabled or one_time is not None
            detail: dict[str, object] = {"user": before.name, "before": _audited(before), "after": _audited(after)}
            event = Event(actor=by, action=CHANGE, detail=detail | {"password_reset": one_time is not None})
            self._store.write(save=[after], drop=self._store.logins_of(before) if ends else [], event=event)
        return Issued(user=after, one_time_password=one_time)

    def _refuse_taken(self, name: str) -> None:
        if any(is_like(user.name, name) for user in self._store.users.values()):
            msg = "this name is or was in use"
            raise NameTakenError(msg, field="name", value=name, bound="a name that was never used")

    def _refuse_no_admin(self, after: User) -> None:
        """Raise LastAdminError if the change leaves no active administrator with a password."""
        others = (user for user in self._store.users.values() if user.key != after.key)
        if not any(_is_active_admin(user) for user in (*others, after)):
            msg = "this is the last active administrator: give another person the role first"
            raise LastAdminError(msg, field="name", value=after.name)

    @staticmethod
    def _refuse_provider_fields(user: User, change: Change) -> None:
        if user.issuer is not None and (change.roles is not None or change.reset_password or change.is_break_glass):
            msg = "roles and password of this person are the identity provider's: they may be disabled here, no more"
            raise OutsideUserError(msg, field="name", value=user.name)


def _is_active_admin(user: User) -> bool:
    return Role.ADMIN in user.roles and not user.is_disabled and user.password_hash is not None


def _require_roles(roles: Iterable[Role]) -> frozenset[Role]:
    required = frozenset(roles)
    if not required:
        bound = f"at least one of {', '.join(Role)}"
        raise BoundError(f"roles must be {bound}", field="roles", value="none", bound=bound)
    return required


def _audited(user: User) -> dict[str, object]:
    return {
        "roles": sorted(user.roles),
        "is_disabled": user.is_disabled,
        "is_break_glass": user.is_break_glass,
        "must_change_password": user.must_change_password,
    }


def make_first_admin(store: AccessStore, accounts: AccountService, on_created: OnFirstAdmin) -> None:
    """Create an administrator with a one-time password if there is no account at all.

    It is a break-glass account: where users log in at an identity provider, other local passwords are not accepted.
    """
    if store.users:
        return
    issued = accounts.add(FIRST_NAME, [Role.ADMIN], by=SYSTEM, is_break_glass=True)
    on_created(issued.user.name, issued.one_time_password or "")
