"""``tidegate export``: a session for other systems: DICOM files, and breathing for 4-D CT."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
import typer

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError, RecordingError, TidegateError
from engine.core.files import open_plain, write_whole
from engine.core.frames import FloatArray
from service.cli.command_group import command_group
from service.cli.data_folder import settings_of_database
from service.cli.terminal import refused, say
from service.core.settings.settings import SettingsError
from service.exchange.four_d_ct import BINS, Sorting, at_times, bins_of, bins_table, phase_list, places_in_breath
from service.exchange.vxp import vxp
from service.sessions.report.exports import SessionExports
from service.sessions.report.reports import report_service
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database
from service.storage.database.startup import SAMPLES_FOLDER
from service.storage.samples.store import SampleStore

ACTOR, ACTION = "tidegate export", "report.export"
SIGNALS = ("whole", "thorax", "abdomen")
MOST_BYTES = 64 * 1024 * 1024
MOST_IMAGES = 100_000

export = command_group("export", "Write a session for other systems: DICOM, and breathing for 4-D CT.")
Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")]
Out = Annotated[Path, typer.Option(help="Folder for the files.")]


class _Curve(NamedTuple):
    """What is sorted: values over time, when the beam was permitted, and whose it is."""

    time_s: npt.NDArray[np.float64]
    motion_mm: FloatArray
    is_on: npt.NDArray[np.bool_]
    patient_id: str


@export.command()
def dicom(
    session: Annotated[str, typer.Argument(help="The session's id.", metavar="SESSION")],
    out: Out,
    deidentify: Annotated[
        str | None,
        typer.Option(
            help="Patient ID in place of the patient's; times and plan go, and no report is written.", metavar="ID"
        ),
    ] = None,
    data: Data = None,
) -> None:
    """Write a session that is over as DICOM: its curve as a waveform, its report as a document.

    The service may be running. The same session gives the same bytes.
    """
    with _refusing("dicom", out), _exports(data) as (exports, log):
        files = {"waveform.dcm": exports.waveform(session, deidentify)}
        if deidentify is None:
            files["report.dcm"] = exports.report(session)
        detail = {"format": "dicom", "is_deidentified": deidentify is not None}
        _write(out, files)
        log.write(Event(actor=ACTOR, action=ACTION, session_id=session, detail=detail))


@export.command("4dct")
def four_d_ct(
    source: Annotated[
        str,
        typer.Argument(
            help="A session's id, motion.csv of `tidegate measure`, or a breathing trace (.vxp, CSV).", metavar="SOURCE"
        ),
    ],
    out: Out,
    signal: Annotated[str, typer.Option(help="Of a session or motion.csv: whole, thorax or abdomen.")] = "whole",
    bins: Annotated[int, typer.Option(help="Bins of the breath, 2 to 20.")] = 10,
    sorting: Annotated[
        Sorting, typer.Option(help="What is equal between bins: time, amplitude, or each breath's own amplitude.")
    ] = Sorting.EQUAL_TIME,
    times: Annotated[
        Path | None,
        typer.Option(help="Times of the images since the first value [s], one a line; each value otherwise."),
    ] = None,
    *,
    is_low_active: Annotated[
        bool, typer.Option("--ttl-low-active", help="In the .vxp an image's mark is 0 in place of 1.")
    ] = False,
    data: Data = None,
) -> None:
    """Write breathing for 4-D CT: RTK's phase list, bins with their residual motion, and a .vxp for research.

    The place in the breath is found in retrospect: 0 is the end of inhale. The .vxp has no checksum.
    """
    with _refusing("4dct", out):
        if signal not in SIGNALS:
            raise InvalidValueError("signal", signal, ", ".join(SIGNALS))
        check_whole_number("bins", bins, *BINS)
        curve = _curve(source, signal, data)
        place = places_in_breath(curve.time_s, curve.motion_mm, sorting)
        images = None if times is None else _times(times)
        listed = place if images is None else at_times(curve.time_s, place, images)
        found = bins_of(curve.motion_mm, place, bins)
        text = vxp(
            time_s=curve.time_s,
            motion_mm=curve.motion_mm,
            place=places_in_breath(curve.time_s, curve.motion_mm),
            is_on=curve.is_on,
            patient_id=curve.patient_id,
            image_s=images,
            is_low_active=is_low_active,
        )
        known = listed if images is not None else listed[np.isfinite(listed)]
        files = {"phases.txt": phase_list(known), "bins.csv": bins_table(found), "curve.vxp": text}
        _write(out, {name: content.encode() for name, content in files.items()})
    worst = max((one.residual_mm or 0.0 for one in found), default=0.0)
    say(f"{len(known)} images, {bins} bins; residual motion at most {worst:.2f} mm (standard deviation)")


def _curve(source: str, signal: str, data: Path | None) -> _Curve:
    path = Path(source)
    if not path.is_file():
        with _exports(data) as (exports, log):
            curve = exports.curve(source)
            log.write(Event(actor=ACTOR, action=ACTION, session_id=source, detail={"format": "4dct"}))
            return _Curve(
                curve.time_s, curve.motion_mm[signal], curve.gates == "beam_on", exports.patient_reference(source)
            )
    if path.suffix.lower() == ".csv":
        table = _motion_table(path, signal)
        if table is not None:
            return table
    from engine.qa import read_trace

    trace = read_trace(path)
    return _Curve(trace.time_s, trace.motion_mm, np.zeros(len(trace.time_s), dtype=bool), path.stem)


def _motion_table(path: Path, signal: str) -> _Curve | None:
    """Read motion.csv; None where the file is another CSV."""
    with open_plain(path) as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise RecordingError(f"{path.name}: is larger than {MOST_BYTES} bytes")
    rows = csv.DictReader(content.decode("utf-8-sig").splitlines())
    columns = set(rows.fieldnames or ())
    if not {"timestamp_us", f"{signal}_mm"} <= columns:
        return None
    try:
        found = [
            (int(row["timestamp_us"]), float(row[f"{signal}_mm"] or "nan"), row.get("gate") == "beam_on")
            for row in rows
        ]
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path.name}: line {rows.line_num}: is no row of motion.csv ({error})") from error
    if len(found) < 2:
        raise RecordingError(f"{path.name}: has {len(found)} rows: must have at least 2")
    at, motion, is_on = (np.array(column) for column in zip(*found, strict=True))
    if not (np.diff(at) > 0).all():
        raise RecordingError(f"{path.name}: timestamp_us must increase")
    return _Curve((at - at[0]) / 1e6, motion, is_on, path.parent.name or path.stem)


def _times(path: Path) -> npt.NDArray[np.float64]:
    """Read times of images [s]."""
    with open_plain(path) as file:
        lines = file.read(MOST_BYTES).decode("utf-8-sig").split()
    try:
        found = np.array([float(one) for one in lines])
    except ValueError as error:
        raise RecordingError(f"{path.name}: must have one time [s] a line ({error})") from error
    if not 1 <= len(found) <= MOST_IMAGES or not np.isfinite(found).all():
        raise RecordingError(f"{path.name}: has {len(found)} times: must have 1 to {MOST_IMAGES}, all finite")
    return found


@contextmanager
def _exports(data: Path | None) -> Iterator[tuple[SessionExports, AuditLog]]:
    settings = settings_of_database(data)
    database = Database(settings.database_place)
    try:
        samples = SampleStore(settings.data_dir / SAMPLES_FOLDER)
        yield SessionExports(database, samples, report_service(database, samples, settings)), AuditLog(database)
    finally:
        database.close()


@contextmanager
def _refusing(command: str, out: Path) -> Iterator[None]:
    try:
        yield
    except (TidegateError, SettingsError) as error:
        raise refused(f"export {command}", error) from error
    except UnicodeDecodeError as error:
        raise refused(f"export {command}", "the file is not UTF-8 text") from error
    except OSError as error:
        reason = f"{error.filename or out} cannot be used ({error.strerror or error})"
        raise refused(f"export {command}", reason) from error


def _write(out: Path, files: dict[str, bytes]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_whole(out / name, content)
    say(f"Written to {out}: {', '.join(files)}")
