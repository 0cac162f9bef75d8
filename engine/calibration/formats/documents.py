"""Parse untrusted JSON, YAML and XML to plain trees: bounded, no key twice, no objects, no expansion.

Scalars of YAML and XML stay text and are converted where a number is expected. YAML is read event by event, so
that aliases (a few hundred bytes that mean a billion nodes) and deep nesting are refused before anything is built; XML
with a document type, where entities come from, likewise.

Numbers, matrices and names from foreign trees; refusals use the names of the source.
"""

import re
from collections.abc import Iterable
from typing import cast
from xml.parsers import expat

import numpy as np
import yaml

from engine.calibration.camera_calibration import STRICT
from engine.core.errors import CalibrationError
from engine.core.frames import FloatArray
from engine.core.strict_json import ROOT

Tree = dict[str, "Tree"] | list["Tree"] | str | int | float | bool | None
# The parser of libyaml where the package was built with it: some twenty times faster.
_YAML_LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
# OpenCV before 5 wrote a line that YAML 1.1 does not know; none of the directives matters here.
_YAML_HEAD = re.compile(r"\A%YAML[^\n]*\n")
_MATRIX_TEXT = "data"
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_MAX_DIGITS = 60
_LARGEST = 1e9
_MATRIX_KEYS = {"rows", "cols", "dt", "data", "type_id"}
# OpenCV's letters for numbers of one channel.
_MATRIX_TYPES = {"d", "f", "i", "s", "w", "c", "u", "1d", "1f"}


def read_documents(text: bytes) -> list[Tree]:
    """Read one file; a YAML file may hold several documents.

    Raises
    ------
    CalibrationError
        Too large, too deep, an alias, a key given twice, or neither JSON nor YAML nor XML.
    """
    if len(text) > STRICT.max_bytes:
        raise CalibrationError(ROOT, f"{len(text)} bytes or more", f"at most {STRICT.max_bytes} bytes")
    start = text.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start[:1] in {b"{", b"["}:
        return [_json(start)]
    try:
        decoded = start.decode()
    except UnicodeDecodeError as error:
        raise CalibrationError(ROOT, f"{len(text)} bytes", "text in UTF-8") from error
    return [_xml(decoded)] if decoded.startswith("<") else _yaml(decoded)


def _json(text: bytes) -> Tree:
    return cast("Tree", STRICT.parse(text))  # json makes nothing else


def _yaml(text: str) -> list[Tree]:
    builder = _Builder()
    try:
        for event in yaml.parse(_YAML_HEAD.sub("", text), Loader=_YAML_LOADER):
            _feed(builder, event)
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # an escaped character that is none is a ValueError
        reason = " ".join(str(error).split())[:80]
        raise CalibrationError(ROOT, f"{len(text)} characters", f"JSON, YAML or XML ({reason})") from error
    return builder.documents


def _feed(builder: "_Builder", event: yaml.Event) -> None:
    if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
        raise CalibrationError(ROOT, "an alias or anchor", "without aliases and anchors")
    if isinstance(event, yaml.MappingStartEvent):
        builder.open({})
    elif isinstance(event, yaml.SequenceStartEvent):
        builder.open([])
    elif isinstance(event, yaml.CollectionEndEvent):
        builder.close()
    elif isinstance(event, yaml.ScalarEvent):
        builder.add(event.value)


class _Builder:
    """Puts a tree together from its parts, in order."""

    def __init__(self) -> None:
        self.documents: list[Tree] = []
        self._open: list[dict[str, Tree] | list[Tree]] = []
        self._keys: list[str | None] = []

    def open(self, container: dict[str, Tree] | list[Tree]) -> None:
        """Begin an object or a list."""
        if len(self._open) >= STRICT.max_nesting:
            bound = f"nested at most {STRICT.max_nesting} deep"
            raise CalibrationError(ROOT, f"nested deeper than {STRICT.max_nesting}", bound)
        self.add(container)
        self._open.append(container)
        self._keys.append(None)

    def close(self) -> None:
        """End the innermost one."""
        self._open.pop()
        self._keys.pop()

    def add(self, value: Tree) -> None:
        """Add a value; in an object, keys and values take turns."""
        if not self._open:
            self.documents.append(value)
            return
        parent, key = self._open[-1], self._keys[-1]
        if isinstance(parent, list):
            parent.append(value)
        elif key is not None:
            parent[key] = value
            self._keys[-1] = None
        elif not isinstance(value, str):
            raise CalibrationError(ROOT, "a key that is no text", "made of keys that are text")
        elif value in parent:
            raise CalibrationError(value[:80], "given twice", "given once")
        else:
            self._keys[-1] = value


def _xml(text: str) -> Tree:
    """Read OpenCV's XML: ``<opencv_storage>`` with a child a key."""
    reader = _XmlReader()
    # Set here, so that no declaration in the file can override it.
    parser = expat.ParserCreate("utf-8")
    parser.StartDoctypeDeclHandler = reader.refuse_doctype
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.characters
    try:
        parser.Parse(text.encode(), True)  # noqa: FBT003 - expat has no names for its arguments
    except expat.ExpatError as error:
        raise CalibrationError(ROOT, f"{len(text)} characters", f"an XML document ({error})") from error
    return reader.root


class _XmlReader:
    """Takes expat's calls; each open element is its name, its children and its text."""

    def __init__(self) -> None:
        self.root: Tree = None
        self._open: list[tuple[str, dict[str, Tree], list[str]]] = []

    def refuse_doctype(self, *_args: object) -> None:
        """Refuse a document type: entities come from there."""
        raise CalibrationError(ROOT, "a document type", "XML without a document type")

    def start(self, name: str, _attributes: dict[str, str]) -> None:
        """Begin an element."""
        if len(self._open) >= STRICT.max_nesting:
            bound = f"nested at most {STRICT.max_nesting} deep"
            raise CalibrationError(ROOT, f"nested deeper than {STRICT.max_nesting}", bound)
        self._open.append((name, {}, []))

    def characters(self, text: str) -> None:
        """Take a piece of text."""
        self._open[-1][2].append(text)

    def end(self, _name: str) -> None:
        """End an element and hand it to its parent."""
        name, children, pieces = self._open.pop()
        value: Tree = children or _xml_text(name, "".join(pieces).strip())
        if not self._open:
            self.root = value
            return
        siblings = self._open[-1][1]
        if name in siblings:
            raise CalibrationError(name[:80], "given twice", "given once")
        siblings[name] = value


def _xml_text(name: str, text: str) -> Tree:
    """OpenCV quotes text with spaces in it; what else has spaces is a list."""
    if text.startswith('"'):
        return text.strip('"')
    parts: list[Tree] = list(text.split())
    return parts if len(parts) > 1 or name == _MATRIX_TEXT else text


def number(field: str, value: Tree) -> float:
    """Take a finite number, written as text or not."""
    if isinstance(value, str) and len(value) <= _MAX_DIGITS and _NUMBER.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        raise CalibrationError(field, value, f"a number from {-_LARGEST:g} to {_LARGEST:g}")
    return float(value)


def whole(field: str, value: Tree) -> int:
    """Take a whole number."""
    found = number(field, value)
    if found != int(found):
        raise CalibrationError(field, value, "a whole number")
    return int(found)


def text(field: str, value: Tree) -> str:
    """Take a text."""
    if not isinstance(value, str):
        raise CalibrationError(field, value, "a text")
    return value


def numbers(field: str, value: Tree) -> list[float]:
    """Take a list of numbers."""
    if not isinstance(value, list):
        raise CalibrationError(field, value, "a list of numbers")
    return [number(f"{field}[{i}]", item) for i, item in enumerate(value)]


def matrix(field: str, value: Tree) -> FloatArray:
    """Take a matrix as OpenCV and ROS write it, ``rows``, ``cols`` and ``data``; shape (rows, cols), float64."""
    if not isinstance(value, dict) or not {"rows", "cols", "data"} <= value.keys():
        raise CalibrationError(field, value, "a matrix: rows, cols and data")
    refuse_unknown(value.keys(), _MATRIX_KEYS, prefix=f"{field}.")
    kind = value.get("dt", "d")
    if kind not in _MATRIX_TYPES:
        raise CalibrationError(f"{field}.dt", kind, "one channel of numbers (d, f or i)")
    rows, columns = (whole(f"{field}.{key}", value[key]) for key in ("rows", "cols"))
    entries = numbers(f"{field}.data", value["data"])
    if rows < 0 or columns < 0 or rows * columns != len(entries):
        raise CalibrationError(f"{field}.data", f"{len(entries)} numbers", f"rows x cols ({rows} x {columns})")
    return np.array(entries, dtype=np.float64).reshape(rows, columns)


def shaped(field: str, value: FloatArray, *shapes: tuple[int, int]) -> FloatArray:
    """Refuse a matrix of another shape."""
    if value.shape not in shapes:
        wanted = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise CalibrationError(field, f"{value.shape[0]} x {value.shape[1]}", wanted)
    return value


def camera_matrix(field: str, value: FloatArray) -> dict[str, float]:
    """Take fx, fy, cx, cy out of a camera matrix without skew, shape (3, 3)."""
    shaped(field, value, (3, 3))
    rest = (value[0, 1], value[1, 0], *value[2])
    if not np.allclose(rest, (0.0, 0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-9):
        raise CalibrationError(field, value.tolist(), "a camera matrix: fx 0 cx, 0 fy cy, 0 0 1")
    entries = {"fx": value[0, 0], "fy": value[1, 1], "cx": value[0, 2], "cy": value[1, 2]}
    return {key: float(entry) for key, entry in entries.items()}


def distortion(field: str, entries: list[float]) -> list[float]:
    """Take k1 k2 p1 p2 k3 out of OpenCV's 4, 5, 8, 12 or 14 coefficients; those beyond must be zero."""
    if len(entries) not in {0, 4, 5, 8, 12, 14}:
        raise CalibrationError(field, f"{len(entries)} numbers", "4, 5, 8, 12 or 14 coefficients")
    for i, entry in enumerate(entries[5:], start=5):
        if entry != 0.0:
            bound = "0: only k1 k2 p1 p2 k3 are used here; calibrate again without a rational model"
            raise CalibrationError(f"{field}[{i}]", entry, bound)
    return (entries + [0.0] * 5)[:5]


def refuse_unknown(keys: Iterable[str], known: Iterable[str], *, prefix: str = "") -> None:
    """Raise CalibrationError for unknown keys."""
    known = set(known)
    for key in keys:
        if key not in known:
            raise CalibrationError(f"{prefix}{key}"[:80], "unknown", f"one of {', '.join(sorted(known))}")
