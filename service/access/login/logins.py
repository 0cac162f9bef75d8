"""Opens and ends log-ins, by a password or by an OpenID Connect provider."""

import hashlib
import secrets
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta

from service.access.accounts.passwords import Hashing, check_password
from service.access.accounts.records import Attempts, Login, User, Way, check_name, is_like, name_key
from service.access.accounts.store import AccessStore
from service.access.login import lockout
from service.access.login.lockout import RefusedLogins
from service.core.errors import LockedOutError, LoginFailedError, NotFoundError, OutsideUserError, WrongPasswordError
from service.core.permissions import Role
from service.storage.audit import Event

LOGIN = "user.login"
BREAK_GLASS = "user.break_glass"
LOGOUT = "user.logout"
PASSWORD = "user.password"  # noqa: S105 - the name of an action
TOKEN_BYTES = 32
MAX_LOGINS = 16
LocalRule = Callable[[User, str | None], bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """One attempt to log in with a password; ``repr`` omits the password.

    ``reason`` is required of break-glass accounts; ``former_token`` is the browser's earlier login, which is ended.
    """

    name: str
    password: str
    address: str
    reason: str | None = None
    former_token: str | None = None

    def __repr__(self) -> str:
        return f"Attempt(name={self.name!r}, address={self.address!r})"


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedLogin:
    """A newly opened log-in and its token, which is sent to the browser and not stored; ``repr`` omits it."""

    token: str
    login: Login
    user: User

    def __repr__(self) -> str:
        return f"OpenedLogin(user={self.user.name!r})"


def hashed(secret: str) -> str:
    """Return the SHA-256 of a token as hex; a token of 256 random bits needs neither salt nor a slow hash."""
    return hashlib.sha256(secret.encode()).hexdigest()


class LoginService:
    """Opens and ends log-ins; each change and its audit row are one transaction.

    Parameters
    ----------
    lasts
        Life of a log-in, whether or not it is used.
    idle
        A log-in without a request for longer than this has expired.
    """

    def __init__(
        self, store: AccessStore, hashing: Hashing, refused_logins: RefusedLogins, *, lasts: timedelta, idle: timedelta
    ) -> None:
        self._store = store
        self._hashing = hashing
        self._refused_logins = refused_logins
        self._lasts = lasts
        self.idle = idle
        self.local_rule: LocalRule = lambda _user, _reason: False
        """Called with a verified password: whether the log-in is break-glass; raises ServiceError to refuse it."""

    def refuse_locked(self, name: str, address: str) -> None:
        """Raise LockedOutError while this name or address is locked; unknown names behave like known ones."""
        now = self._store.now()
        subjects = (lockout.name_subject(name), lockout.address_subject(address))
        left_s = max(lockout.wait_s(self._store.attempts.get(subject), now) for subject in subjects)
        if left_s > 0:
            self._refused_logins.count("locked out", address)
            raise LockedOutError(left_s)

    def verify(self, attempt: Attempt) -> User:
        """Verify a password, and open nothing; takes tens of milliseconds, so call it in the password thread.

        One hash is verified per call, a dummy one for an unknown name, so that neither the answer nor its duration
        reveals which names exist.

        Raises
        ------
        LockedOutError
            The name or the address has to wait.
        LoginFailedError
            Unknown name, wrong password or disabled account.
        """
        self.refuse_locked(attempt.name, attempt.address)
        user = self._store.users.get(name_key(attempt.name))
        is_right = self._hashing.verify(None if user is None else user.password_hash, attempt.password)
        if user is None or not is_right or user.is_disabled:
            self._record_failure(attempt, user)
            raise LoginFailedError
        return user

    def log_in(self, attempt: Attempt) -> OpenedLogin:
        """Verify a password and open a log-in; raise as `verify` does."""
        user = self.verify(attempt)
        is_break_glass = self.local_rule(user, attempt.reason)
        with self._store.changing:
            user = self._store.users[user.key]
            if user.is_disabled:  # while the password was checked
                raise LoginFailedError
            if user.password_hash is not None and self._hashing.is_outdated(user.password_hash):
                user = replace(user, password_hash=self._hashing.hash(attempt.password))
            detail: dict[str, object] = {"way": "password"}
            if is_break_glass:
                detail |= {"reason": attempt.reason}
            action = BREAK_GLASS if is_break_glass else LOGIN
            return self._open(user, attempt.address, "password", action, detail, former=attempt.former_token)

    def open_oidc(
        self, *, issuer: str, subject: str, name: str, name_if_taken: str, roles: frozenset[Role], address: str
    ) -> OpenedLogin:
        """Open a log-in for a user of the identity provider, with the roles of this log-in; create the account if new.

        Raises
        ------
        LoginFailedError
            The account is disabled, or both names are taken.
        """
        with self._store.changing:
            user = next(
                (one for one in self._store.users.values() if (one.issuer, one.subject) == (issuer, subject)), None
            )
            if user is not None and user.is_disabled:
                raise LoginFailedError
            if user is None:
                known = [one.name for one in self._store.users.values()]
                chosen = check_name(name_if_taken if any(is_like(one, name) for one in known) else name)
                if any(is_like(one, chosen) for one in known):
                    raise LoginFailedError
                user = User(
                    name=chosen,
                    password_hash=None,
                    roles=roles,
                    issuer=issuer,
                    subject=subject,
                    created_at=self._store.now(),
                )
            detail: dict[str, object] = {
                "way": "oidc",
                "issuer": issuer,
                "subject": subject,
                "roles": sorted(roles),
                "roles_before": sorted(user.roles),
            }
            return self._open(replace(user, roles=roles), address, "oidc", LOGIN, detail)

    def _open(
        self,
        user: User,
        address: str,
        way: Way,
        action: str | None,
        detail: dict[str, object],
        *,
        former: str | None = None,
    ) -> OpenedLogin:
        now = self._store.now()
        token = secrets.token_urlsafe(TOKEN_BYTES)
        login = Login(
            id=uuid.uuid4().hex,
            token_sha256=hashed(token),
            user_key=user.key,
            way=way,
            address=address,
            is_break_glass=action == BREAK_GLASS,
            created_at=now,
            expires_at=now + self._lasts,
            seen_at=now,
        )
        user = replace(user, last_login_at=now)
        open_logins = self._store.logins_of(user)
        dropped: list[Login | Attempts] = list(open_logins[: max(0, len(open_logins) - MAX_LOGINS + 1)])
        if former is not None and (old := self._store.logins.get(hashed(former))) is not None and old not in dropped:
            dropped.append(old)
        failures = self._store.attempts.get(lockout.name_subject(user.name))
        if failures is not None:
            dropped.append(failures)
        audited = {"roles": sorted(user.roles), **detail, "login_id": login.id, "address": address}
        event = None if action is None else Event(actor=user.name, action=action, detail=audited)
        self._store.write(save=[user, login], drop=dropped, event=event)
        return OpenedLogin(token=token, login=login, user=user)

    def _record_failure(self, attempt: Attempt, user: User | None) -> None:
        """Count a failure for the name and the address; the counts in memory change even if the database fails."""
        store = self._store
        with store.changing:
            now = store.now()
            subjects = (lockout.name_subject(attempt.name), lockout.address_subject(attempt.address))
            failed = [lockout.failed_again(store.attempts.get(subject), subject, now) for subject in subjects]
            store.attempts.update({one.subject: one for one in failed})
            dropped = _surplus(store.attempts, keep=set(subjects))
            if user is None:
                self._refused_logins.count("failed log-ins of unknown names", attempt.address)
            else:
                detail = {"address": attempt.address, "failures": failed[0].failures, "is_disabled": user.is_disabled}
                self._refused_logins.record(Event(actor=user.name, action=LOGIN, outcome="refused", detail=detail))
            store.write(save=failed, drop=dropped)

    def log_out(self, login: Login) -> None:
        """End a log-in by its own user."""
        self.end(login, by=self._store.users[login.user_key].name)

    def end(self, login: Login, *, by: str) -> None:
        """End a log-in and audit who did it; its open WebSockets close within seconds."""
        name = self._store.users[login.user_key].name
        event = Event(actor=by, action=LOGOUT, detail={"login_id": login.id, "user": name})
        self._store.write(drop=[login], event=event)

    def find(self, user: User, login_id: str) -> Login:
        """Return a user's log-in by its id; raise NotFoundError if there is none."""
        for login in self._store.logins_of(user):
            if login.id == login_id:
                return login
        msg = "there is no such log-in"
        raise NotFoundError(msg, field="login_id", value=login_id)

    def change_password(self, user: User, old: str, new: str, *, address: str, keep: Login | None) -> None:
        """Change a user's own password and end the user's log-ins except ``keep``; call it in the password thread.

        Raises
        ------
        OutsideUserError
            The account is the identity provider's.
        LockedOutError
            The name or the address has to wait.
        BoundError
            The new password is not allowed.
        WrongPasswordError
            The old password is wrong, or the new one is the same.
        """
        if user.issuer is not None:
            msg = "the password is kept by the identity provider: change it there"
            raise OutsideUserError(msg)
        self.refuse_locked(user.name, address)
        check_password(new, user.name)
        if not self._hashing.verify(user.password_hash, old):
            self._record_failure(Attempt(name=user.name, password="", address=address), user)
            msg = "the old password is wrong"
            raise WrongPasswordError(msg, field="old_password", bound="the present password")
        if new == old:
            msg = "the new password must be another one"
            raise WrongPasswordError(msg, field="new_password", bound="another one than the old")
        new_hash = self._hashing.hash(new)
        with self._store.changing:
            current = self._store.users[user.key]
            changed = replace(current, password_hash=new_hash, must_change_password=False)
            others = [one for one in self._store.logins_of(current) if keep is None or one.id != keep.id]
            self._store.write(save=[changed], drop=others, event=Event(actor=user.name, action=PASSWORD))


def _surplus(attempts: dict[str, Attempts], keep: set[str]) -> list[Attempts]:
    """Return the failure counts to delete above the limit: those without a lock first, then the oldest."""
    beyond = len(attempts) - lockout.MAX_SUBJECTS
    if beyond <= 0:
        return []
    others = sorted(
        (one for one in attempts.values() if one.subject not in keep),
        key=lambda one: (one.locked_until is not None, one.last_at),
    )
    return others[:beyond]
