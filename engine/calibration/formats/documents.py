"""Parse untrusted JSON, YAML and XML to plain trees: bounded, no key twice, no objects, no expansion.

Scalars of YAML and XML stay text and are converted where a number is expected. YAML is read event by event, so
that aliases (a few hundred bytes that mean a billion nodes) and deep nesting are refused before anything is built; XML
with a document type, where entities come from, likewise.
"""

import re
from typing import cast
from xml.parsers import expat

import yaml

from engine.core.errors import CalibrationError
from engine.core.strict_json import ROOT, StrictJson

Tree = dict[str, "Tree"] | list["Tree"] | str | int | float | bool | None
STRICT = StrictJson(error=CalibrationError)
# The parser of libyaml where the package was built with it: some twenty times faster.
_YAML_LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
# OpenCV before 5 wrote a line that YAML 1.1 does not know; none of the directives matters here.
_YAML_HEAD = re.compile(r"\A%YAML[^\n]*\n")
_MATRIX_TEXT = "data"


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
