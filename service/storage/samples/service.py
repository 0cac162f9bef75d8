"""Export of samples over the API: of a running session as far as they are written, of a closed one all."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Literal

from engine.core.files import PIECE_BYTES
from service.core.errors import SamplesRemovedError, SessionStateError
from service.core.schemas import sessions
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.samples.export import arrow_pieces, csv_pieces
from service.storage.samples.layout import SampleHead
from service.storage.samples.store import SampleStore

SampleFormat = Literal["csv", "arrow", "parquet"]
MEDIA: dict[SampleFormat, str] = {
    "csv": "text/csv",
    "arrow": "application/vnd.apache.arrow.stream",
    "parquet": "application/vnd.apache.parquet",
}
SUFFIX: dict[SampleFormat, Literal[".csv", ".arrows", ".parquet"]] = {
    "csv": ".csv",
    "arrow": ".arrows",
    "parquet": ".parquet",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleExport:
    """A session's samples in one format, read from the disk piece by piece as ``pieces`` is consumed."""

    pieces: Iterator[bytes]
    media_type: str
    file_name: str


class SampleService:
    """Exports the samples of sessions."""

    def __init__(self, database: Database, store: SampleStore) -> None:
        self._database = database
        self._store = store

    def export(self, session_id: str, form: SampleFormat) -> SampleExport:
        """Export a session's samples.

        Raises
        ------
        SamplesRemovedError
            They were removed; the audit has the reason.
        SessionStateError
            Parquet was requested before the session is closed.
        """
        with self._database.read() as db:
            row = queries.session_row(db, session_id)
            named = [region.name for region in sessions.Regions.model_validate_json(row.regions).named]
            self._refuse_removed(session_id, row.summary)
        pieces = self._csv(session_id, named) if form == "csv" else self._binary(session_id, form, tuple(named))
        return SampleExport(pieces=pieces, media_type=MEDIA[form], file_name=f"{session_id}{SUFFIX[form]}")

    def _csv(self, session_id: str, named: list[str]) -> Iterator[bytes]:
        batches = self._store.batches(
            session_id
        )  # opened now: an error is then refused as a problem, not as a broken answer
        return (text.encode() for text in csv_pieces(batches, named))

    def _binary(self, session_id: str, form: SampleFormat, named: tuple[str, ...]) -> Iterator[bytes]:
        if form == "arrow":
            head = self._store.head(session_id) or SampleHead(session_id=session_id, regions=named)
            return arrow_pieces(self._store.batches(session_id), head.schema)
        path = self._store.parquet_path(session_id)
        try:
            file = path.open("rb")
        except FileNotFoundError as error:
            msg = "Parquet is made when the session closes: ask for csv or arrow until then"
            raise SessionStateError(msg, field="format", value=form, bound="csv or arrow") from error
        return _read(file)

    def _refuse_removed(self, session_id: str, summary: str | None) -> None:
        if summary is None or self._store.has(session_id):
            return
        if sessions.Summary.model_validate_json(summary).frames:
            msg = "the session's samples have been removed; the audit has the time and the reason"
            raise SamplesRemovedError(msg, field="session_id", value=session_id)


def _read(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while piece := file.read(PIECE_BYTES):
            yield piece
