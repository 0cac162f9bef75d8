"""Samples for whoever asks over the API: what is written so far of a session that runs, all of one that is closed."""

from collections.abc import Iterator
from typing import BinaryIO, Literal

from service import schemas
from service.db import repository
from service.db.engine import Database
from service.errors import SamplesRemovedError, SessionStateError
from service.ports import SampleExport, SampleFormat
from service.samples.durable import PIECE_BYTES
from service.samples.export import arrow_pieces, csv_pieces
from service.samples.layout import SampleHead
from service.samples.shelf import SampleShelf

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


class SampleDesk:
    """Gives samples out."""

    def __init__(self, database: Database, shelf: SampleShelf) -> None:
        self._database = database
        self._shelf = shelf

    def export(self, session_id: str, form: SampleFormat) -> SampleExport:
        """Write a session's samples piece by piece."""
        with self._database.read() as db:
            row = repository.session_row(db, session_id)
            named = [region.name for region in schemas.Regions.model_validate_json(row.regions).named]
            self._refuse_removed(session_id, row.summary)
        pieces = self._csv(session_id, named) if form == "csv" else self._binary(session_id, form, tuple(named))
        return SampleExport(pieces=pieces, media_type=MEDIA[form], file_name=f"{session_id}{SUFFIX[form]}")

    def _csv(self, session_id: str, named: list[str]) -> Iterator[bytes]:
        batches = self._shelf.batches(session_id)  # opened now, so that what cannot be is refused and not broken off
        return (text.encode() for text in csv_pieces(batches, named))

    def _binary(self, session_id: str, form: SampleFormat, named: tuple[str, ...]) -> Iterator[bytes]:
        if form == "arrow":
            head = self._shelf.head(session_id) or SampleHead(session_id=session_id, regions=named)
            return arrow_pieces(self._shelf.batches(session_id), head.schema)
        path = self._shelf.parquet_path(session_id)
        try:
            file = path.open("rb")
        except FileNotFoundError as error:
            msg = "Parquet is made when the session closes: ask for csv or arrow until then"
            raise SessionStateError(msg, field="format", value=form, bound="csv or arrow") from error
        return _read(file)

    def _refuse_removed(self, session_id: str, summary: str | None) -> None:
        if summary is None or self._shelf.has(session_id):
            return
        if schemas.Summary.model_validate_json(summary).frames:
            msg = "the session's samples are not there any more; the audit says when they were removed, and why"
            raise SamplesRemovedError(msg, field="session_id", value=session_id)


def _read(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while piece := file.read(PIECE_BYTES):
            yield piece
