"""Creates the first administrator at the first start, when no account exists to create another."""

from collections.abc import Callable

from service.access.accounts.people import AccountService
from service.access.accounts.store import AccessStore
from service.core.permissions import Role
from service.storage.audit import SYSTEM

FIRST_NAME = "admin"
OnFirstAdmin = Callable[[str, str], None]
"""Receives the name and the one-time password, which is not stored."""


def make_first_admin(store: AccessStore, accounts: AccountService, on_created: OnFirstAdmin) -> None:
    """Create an administrator with a one-time password if there is no account at all.

    It is a break-glass account: where users log in at an identity provider, other local passwords are not accepted.
    """
    if store.users:
        return
    issued = accounts.add(FIRST_NAME, [Role.ADMIN], by=SYSTEM, is_break_glass=True)
    on_created(issued.user.name, issued.one_time_password or "")
