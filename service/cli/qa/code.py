"""``tidegate qa code``: make and display a one-time code for a QA run that is started over the API."""

from contextlib import closing
from pathlib import Path

import typer
from sqlalchemy.exc import OperationalError

from engine.core.errors import TidegateError
from service.access.accounts.names import name_key
from service.access.accounts.store import AccessStore
from service.cli.access.account_services import BY
from service.cli.data_folder import settings_of_database
from service.cli.terminal import refused
from service.core.errors import BoundError, NotFoundError
from service.core.permissions import Permission, permissions_of
from service.core.settings.settings import SettingsError
from service.qa.one_time_code import VALID_S, OneTimeCodes
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database

ACTION = "qa.code"
COMMAND = "qa code"


def show_code(data: Path | None, operator: str) -> None:
    """Audit, make and print a code for a person who may start QA; nothing is made if that cannot be audited."""
    try:
        settings = settings_of_database(data)
        with closing(Database(settings.database_place)) as database:
            name = _physicist(database, operator)
            AuditLog(database).write(Event(actor=BY, action=ACTION, detail={"operator": name, "valid_s": VALID_S}))
        text = OneTimeCodes(settings.data_dir).make(name)
    except OperationalError as error:
        text = "the database does not answer, or has an older schema: run `tidegate database upgrade`"
        raise refused(COMMAND, text) from error
    except OSError as error:
        raise refused(COMMAND, f"{settings.data_dir} cannot be written ({error.strerror or error})") from error
    except (SettingsError, TidegateError) as error:
        raise refused(COMMAND, error) from error
    typer.echo(f"{text}  for {name}, for {VALID_S / 60.0:g} minutes and one run. Its drills permit the real beam line.")


def _physicist(database: Database, operator: str) -> str:
    """Return the account's name; raise NotFoundError or BoundError if this person may not start QA."""
    store = AccessStore(database)
    store.load()
    user = store.users.get(name_key(operator))
    if user is None:
        msg = f"there is no account {operator!r}"
        raise NotFoundError(msg, field="operator", value=operator)
    if user.is_disabled or Permission.QA_RUN not in permissions_of(user.roles):
        bound = "an enabled account with the role physicist"
        msg = f"{user.name} may not start QA runs: --operator must be {bound}"
        raise BoundError(msg, field="operator", value=user.name, bound=bound)
    return user.name
