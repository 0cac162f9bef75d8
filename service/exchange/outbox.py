"""Sessions on their way to a PACS: one small file for each in the data folder, so that a restart forgets none."""

import json
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from engine.core.files import write_whole

FOLDER = "pacs"
MOST_BYTES = 16_384


@dataclass(frozen=True, slots=True, kw_only=True)
class Sending:
    """One session, and how far it is.

    Attributes
    ----------
    state
        ``waiting`` until the PACS has taken both files, then ``sent``.
    tries
        Attempts that failed.
    trouble
        Why the last one did; empty without one.
    transaction, committed_at
        UID of the commitment that the PACS was asked for, and when it confirmed it; empty and None without.
    """

    session_id: str
    asked_by: str
    asked_at: str
    state: Literal["waiting", "sent"] = "waiting"
    tries: int = 0
    trouble: str = ""
    sent_at: str | None = None
    transaction: str = ""
    committed_at: str | None = None


class Outbox:
    """The files; any thread may ask and read, one sends.

    Parameters
    ----------
    pacs
        As the site names it; empty is none.
    takes_signed
        Whether a session is sent once its report is signed.
    """

    def __init__(self, data_dir: Path, *, pacs: str = "", takes_signed: bool = False) -> None:
        self._folder = data_dir / FOLDER
        self.pacs, self.takes_signed = pacs, bool(pacs) and takes_signed
        self._lock = threading.Lock()

    def ask(self, session_id: str, by: str) -> Sending:
        """Ask for a session to be sent, or to be sent again."""
        made = Sending(session_id=session_id, asked_by=by, asked_at=datetime.now(UTC).isoformat())
        self._write(made)
        return made

    def all(self) -> list[Sending]:
        """Return every session that was asked for, oldest first."""
        return sorted(self._read(), key=lambda one: (one.asked_at, one.session_id))

    def waiting(self) -> list[Sending]:
        """Return those that the PACS does not have yet, oldest first."""
        return [one for one in self.all() if one.state == "waiting"]

    def begin(self, sending: Sending, transaction: str) -> None:
        """Keep the UID of the commitment that will be asked for: the PACS may confirm before it is asked to the end."""
        self._change(sending, transaction=transaction)

    def has_sent(self, sending: Sending, transaction: str = "", *, is_asked: bool = False) -> None:
        """Note that the PACS has the session, and whether it was asked to confirm that it keeps it.

        One that was asked for again meanwhile stays waiting, and one of which the PACS has said already that it lost
        it: its transaction is gone.
        """
        kept = transaction if is_asked else ""
        now = datetime.now(UTC).isoformat()
        self._change(sending, of=transaction, state="sent", trouble="", sent_at=now, transaction=kept)

    def has_failed(self, sending: Sending, trouble: str) -> None:
        """Note that an attempt failed."""
        self._change(sending, tries=sending.tries + 1, trouble=trouble[:300])

    def has_committed(self, sending: Sending) -> None:
        """Note that the PACS is responsible for the session's files from now on."""
        self._change(sending, committed_at=datetime.now(UTC).isoformat())

    def has_lost(self, sending: Sending, trouble: str) -> None:
        """Note that the PACS does not keep what it took: it is sent again."""
        self._change(sending, state="waiting", transaction="", trouble=trouble[:300])

    def _change(self, sending: Sending, of: str | None = None, **changed: Any) -> None:  # noqa: ANN401 - of several types
        with self._lock:
            for one in self._read():
                is_it = (one.session_id, one.asked_at) == (sending.session_id, sending.asked_at)
                if is_it and of in {None, one.transaction}:
                    self._put(replace(one, **changed))

    def _write(self, sending: Sending) -> None:
        with self._lock:
            self._put(sending)

    def _put(self, sending: Sending) -> None:
        self._folder.mkdir(mode=0o700, exist_ok=True)
        write_whole(self._folder / f"{sending.session_id}.json", json.dumps(asdict(sending)).encode())

    def _read(self) -> Iterator[Sending]:
        for path in self._folder.glob("*.json"):
            try:
                content = path.read_bytes()[:MOST_BYTES]
                yield Sending(**json.loads(content))
            except (OSError, TypeError, ValueError):
                yield Sending(
                    session_id=path.stem, asked_by="", asked_at="", trouble="its file is damaged: ask for it again"
                )
