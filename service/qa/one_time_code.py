"""One-time codes for QA runs on a real beam line, made and displayed at the machine.

A code proves that the person who starts a run over the network can also act at the machine: only a process that may
write to the service's data folder can make one. It is valid for five minutes by both clocks of the machine, once, for
one person, and for three tries. The file holds its argon2id hash; each try is counted before it is checked.
"""

import secrets
import threading
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, ValidationError

from engine.core.clock import NS_PER_S
from engine.core.files import open_plain, remove, whole_file
from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.records import name_key
from service.core.errors import QaCodeError
from service.storage.database.base import TimeAnchor

FILE_NAME = "qa-code.json"
ALPHABET = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
"""32 characters that are not confused in print: no 0, 1, I or O."""
GROUPS, GROUP_LENGTH = 2, 4
VALID_S = 300.0
MAX_TRIES = 3
OWNER_ONLY = 0o600
LONGEST_FILE = 4_096
COMMAND = "tidegate qa code"
MISSING, WRONG = "missing", "not valid"


class _KeptCode(BaseModel):
    """A code as stored: its hash, its person, and when it was made by both clocks."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["tidegate.qa-code/1"] = "tidegate.qa-code/1"
    operator: str
    code_hash: str
    made_at: AwareDatetime
    made_ns: int
    tries: int = 0

    def is_fresh(self, now: TimeAnchor) -> bool:
        """Whether the code is younger than `VALID_S` by the wall clock and by the monotonic clock."""
        wall_s = (now.at - self.made_at) / timedelta(seconds=1)
        steady_s = (now.at_ns - self.made_ns) / NS_PER_S
        return all(0.0 <= age_s <= VALID_S for age_s in (wall_s, steady_s))


class OneTimeCodes:
    """Makes and redeems the code of one data folder; at most one exists at a time.

    Parameters
    ----------
    now
        Reads both clocks; the monotonic one is the machine's, so that it agrees between processes.
    """

    def __init__(self, folder: Path, *, now: Callable[[], TimeAnchor] = TimeAnchor.now) -> None:
        self._path = folder / FILE_NAME
        self._hashing = Argon2Hashing()
        self._lock = threading.Lock()
        self.now = now

    def make(self, operator: str) -> str:
        """Store a new code for a person in place of the present one, and return it; raise OSError on failure."""
        text = "".join(secrets.choice(ALPHABET) for _ in range(GROUPS * GROUP_LENGTH))
        now = self.now()
        code_hash = self._hashing.hash(text)
        self._write(_KeptCode(operator=operator, code_hash=code_hash, made_at=now.at, made_ns=now.at_ns))
        return "-".join(text[start : start + GROUP_LENGTH] for start in range(0, len(text), GROUP_LENGTH))

    def redeem(self, text: str | None, operator: str) -> datetime:
        """Use the code up and return when it was made.

        Raises
        ------
        QaCodeError
            No code was given; or it is wrong, expired, used, or another person's; or its use cannot be recorded.
        """
        if text is None:
            raise _refusal(MISSING)
        with self._lock:
            try:
                return self._redeemed(text, operator)
            except OSError as error:
                raise _refusal(WRONG) from error

    def _redeemed(self, text: str, operator: str) -> datetime:
        kept = self._read()
        if kept is None:
            raise _refusal(WRONG)
        if not kept.is_fresh(self.now()) or kept.tries >= MAX_TRIES:
            remove(self._path)
            raise _refusal(WRONG)
        kept = kept.model_copy(update={"tries": kept.tries + 1})
        self._write(kept)  # before the check, so that a process that ends meanwhile gives no try away
        is_right = self._hashing.verify(kept.code_hash, _typed(text)) and name_key(operator) == name_key(kept.operator)
        if is_right or kept.tries >= MAX_TRIES:
            remove(self._path)
        if not is_right:
            raise _refusal(WRONG)
        return kept.made_at

    def _read(self) -> _KeptCode | None:
        """Return the stored code; None if there is none or the file is damaged."""
        try:
            with open_plain(self._path) as file:
                return _KeptCode.model_validate_json(file.read(LONGEST_FILE))
        except (FileNotFoundError, ValidationError):
            return None

    def _write(self, kept: _KeptCode) -> None:
        with whole_file(self._path, mode=OWNER_ONLY, is_durable=True) as file:
            file.write(kept.model_dump_json().encode())


def _typed(text: str) -> str:
    """Return a code without what people type differently: case, hyphens and spaces."""
    return "".join(text.split()).replace("-", "").upper()


def _refusal(value: str) -> QaCodeError:
    bound = f"the code that `{COMMAND}` displays at the machine, valid for {VALID_S / 60.0:g} minutes, once, for you"
    return QaCodeError(f"code must be {bound}", field="code", value=value, bound=bound)
