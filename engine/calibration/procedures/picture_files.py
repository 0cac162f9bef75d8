"""Pairs of pictures: by equal names, else by their order."""

import glob
from pathlib import Path

from engine.core.errors import InvalidValueError

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")
MOST_PICTURES = 200


def list_pictures(field: str, where: str) -> list[Path]:
    """List a folder's pictures, or a pattern's, sorted by name; raise InvalidValueError when there are none."""
    folder = Path(where)
    found = folder.iterdir() if folder.is_dir() else (Path(name) for name in glob.glob(where))  # noqa: PTH207 - absolute patterns too
    pictures = sorted(path for path in found if path.suffix.lower() in SUFFIXES and path.is_file())
    if not 1 <= len(pictures) <= MOST_PICTURES:
        bound = f"a folder or a pattern with 1 to {MOST_PICTURES} pictures ({' '.join(SUFFIXES)})"
        raise InvalidValueError(field, f"{where} ({len(pictures)} pictures)", bound)
    return pictures


def match_pictures(depth: list[Path], color: list[Path]) -> tuple[list[tuple[Path, Path]], list[str]]:
    """Pair the depth camera's pictures with the colour camera's.

    Returns
    -------
    tuple
        The pairs, and the names of pictures without a partner.

    Raises
    ------
    InvalidValueError
        No names are equal, and the numbers of pictures differ.
    """
    by_stem = {path.stem: path for path in color}
    if len(by_stem) != len(color) or len({path.stem for path in depth}) != len(depth):
        raise InvalidValueError("pictures", "two of one name", "one picture of a name for each camera")
    pairs = [(path, by_stem[path.stem]) for path in depth if path.stem in by_stem]
    if pairs:
        paired = {path.stem for path, _ in pairs}
        return pairs, [path.name for path in depth + color if path.stem not in paired]
    if len(depth) != len(color):
        bound = f"as many as the depth camera's ({len(depth)}), or named as they are"
        raise InvalidValueError("color-pictures", f"{len(color)} pictures", bound)
    return list(zip(depth, color, strict=True)), []
