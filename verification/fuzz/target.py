"""What one target is: a reader, what it may refuse with, and where its inputs come from."""

import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent
CORPUS = FOLDER / "corpus"
MEMORY = Path("/dev/shm")
_given: list[Path] = []


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A reader of unknown callers' bytes.

    Attributes
    ----------
    reads
        What it reads, for the table.
    read
        Reads one input; returns, or raises one of ``refusals``.
    seeds
        Inputs by construction, from which the corpus grew; small, and at least one that is read to its end.
    max_bytes
        The longest input that is tried.
    words
        What such inputs are made of, where guessing letters would take for ever.
    """

    name: str
    reads: str
    read: Callable[[bytes], object]
    refusals: tuple[type[BaseException], ...]
    seeds: Callable[[], Iterable[bytes]]
    max_bytes: int = 4096
    words: tuple[str, ...] = ()

    @property
    def archive(self) -> Path:
        """The file with the inputs that are kept."""
        return CORPUS / f"{self.name}.zip"

    def kept(self) -> dict[str, bytes]:
        """Return the inputs that are kept, by name."""
        if not self.archive.is_file():
            return {}
        with zipfile.ZipFile(self.archive) as archive:
            return {name: archive.read(name) for name in sorted(archive.namelist())}

    def keep(self, inputs: Mapping[str, bytes]) -> None:
        """Keep these inputs and no others; the same ones give the same file."""
        self.archive.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(self.archive, "w") as archive:
            for name in sorted(inputs):
                archive.writestr(zipfile.ZipInfo(name), inputs[name], zipfile.ZIP_DEFLATED)

    def try_one(self, content: bytes) -> bool:
        """Read one input; tell whether it was read, rather than refused as documented."""
        try:
            self.read(content)
        except self.refusals as error:
            check_refusal(error)
            return False
        return True


def check_refusal(error: BaseException) -> None:
    """A refusal is a line for a person: short, and made of whole characters, whatever it is about."""
    text = str(error)
    text.encode()
    str(getattr(error, "field", "")).encode()
    assert text, f"{type(error).__name__} says nothing"
    assert len(text) < 2000, f"{type(error).__name__} says {len(text)} characters"


@contextmanager
def folder_of_inputs() -> Iterator[None]:
    """Keep the inputs of child processes in a folder that goes with this block: libFuzzer ends them at once."""
    with tempfile.TemporaryDirectory(prefix="tidegate-fuzz-", dir=MEMORY if MEMORY.is_dir() else None) as name:
        _folder.cache_clear()
        _given.append(Path(name))
        try:
            yield
        finally:
            _given.pop()
            _folder.cache_clear()


@cache
def _folder() -> Path:
    """A folder of this process, in memory where there is some."""
    if _given:
        return _given[-1]
    kept = tempfile.TemporaryDirectory(prefix="tidegate-fuzz-", dir=MEMORY if MEMORY.is_dir() else None)
    _folder.kept = kept  # removed with the process
    return Path(kept.name)


def as_file(content: bytes, name: str) -> Path:
    """Put an input where a reader of files finds it."""
    path = _folder() / name
    path.write_bytes(content)
    return path
