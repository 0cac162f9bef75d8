"""Which recordings a session may open: files inside the site's folders, wherever links may point.

Rule for a played recording with a real beam line: refused unless the site states that no patient can be in the beam.

The patient on the couch is not the recorded one, and the recording breathes independently of the patient.
"""

from pathlib import Path

from engine.core.sentences import say
from service.core.errors import BoundError, NotFoundError
from service.core.schemas import sessions
from service.core.settings.names import PREFIX
from service.core.settings.settings import Settings

FIELD = "source.path"
RECORDINGS = "*.oni"
KIND_FIELD = "source.kind"
WARNING = say("RECORDING: a played recording, and no patient, gates a REAL beam line")


def find_recording(path: str, folders: tuple[Path, ...], field: str = FIELD) -> Path:
    """Resolve a path from a request, which gave it in ``field``.

    Raises
    ------
    BoundError
        It leads out of the allowed folders, or names a different file in two of them.
    NotFoundError
        No such file.
    """
    inside = [found for found in (_inside(folder, path) for folder in folders) if found is not None]
    files = list(dict.fromkeys(found for found in inside if _is_file(found)))
    if len(files) > 1:
        bound = "the path of one file: rename one of the two"
        msg = f"{field} names two files, {files[0]} and {files[1]}; it must be {bound}"
        raise BoundError(msg, field=field, value=path, bound=bound)
    if files:
        return files[0]
    if inside:
        msg = "there is no such recording"
        raise NotFoundError(msg, field=field, value=path, bound="a file in an allowed folder")
    bound = f"inside one of the allowed folders ({', '.join(str(folder) for folder in folders)})"
    msg = f"{field} must be {bound}"
    raise BoundError(msg, field=field, value=path, bound=bound)


def recording_paths(folders: tuple[Path, ...]) -> list[str]:
    """List the paths of all recordings (``*.oni``) below their folders, in order, as `find_recording` takes them.

    A name that is not UTF-8 is left out: no request can contain it.
    """
    found = {str(file.relative_to(folder)) for folder in folders for file in folder.rglob(RECORDINGS)}
    return sorted(path for path in found if path == path.encode(errors="replace").decode())


def refuse_same_names(folders: tuple[Path, ...]) -> None:
    """Refuse folders in which two recordings (``*.oni``) have the same path below their folder.

    Raises
    ------
    BoundError
        Names both files: a session that asks for this path could open either.
    """
    seen: dict[Path, Path] = {}
    for folder in folders:
        for file in sorted(folder.rglob(RECORDINGS)):
            path = file.relative_to(folder)
            other = seen.setdefault(path, file)
            if other.resolve() != file.resolve():
                msg = f"two recordings have the path {path}: {other} and {file}; rename one of them"
                raise BoundError(msg, field="recordings_dirs", value=str(path), bound="one recording per path")


def _inside(folder: Path, path: str) -> Path | None:
    """Follow a path from a folder, links and all; None where it leads out, in a circle, or nowhere that has a name."""
    try:
        root = folder.resolve()
        found = (root / path).resolve()
    except (OSError, RuntimeError, ValueError):  # a name that is too long, links in a circle, a NUL
        return None
    return found if found.is_relative_to(root) else None


def _is_file(path: Path) -> bool:
    """Whether this is a file; a name too long for the file system is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def check_source(source: sessions.RecordingSource | sessions.DeviceSource, settings: Settings) -> None:
    """Refuse a recording where any line is real and the site does not allow it; raise BoundError."""
    if not isinstance(source, sessions.RecordingSource) or not settings.has_real_beam or settings.recordings_may_gate:
        return
    bound = (
        f"a camera: the beam line is real ({' and '.join(settings.beam_lines)}), and what a recording shows is not the "
        f"patient. On a bench without one set {PREFIX}RECORDINGS_MAY_GATE=true"
    )
    raise BoundError(f"{KIND_FIELD} must be {bound}", field=KIND_FIELD, value=source.kind, bound=bound)


def warning_of_source(
    source: sessions.RecordingSource | sessions.DeviceSource, *, is_simulated_beam: bool
) -> str | None:
    """Return the audit's note for a session whose recording gates a real line."""
    return WARNING if isinstance(source, sessions.RecordingSource) and not is_simulated_beam else None


def described_source(source: sessions.RecordingSource | sessions.DeviceSource, settings: Settings) -> dict[str, object]:
    """Tell the audit, loudly, where a recording gates a real line; nothing otherwise."""
    warning = warning_of_source(source, is_simulated_beam=not settings.has_real_beam)
    return {} if warning is None else {"source_warning": f"{warning} ({' and '.join(settings.beam_lines)})"}
