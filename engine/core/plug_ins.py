"""Plug-ins: cameras and beam lines of other distributions, found by their entry points.

Nothing of a plug-in runs until :meth:`PlugIn.load`. Its hash is over the files that its distribution installed, so a
site names what it has tested; one that is installed for editing has none, since its files lie elsewhere.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

from engine.core.errors import TidegateError

CAMERAS = "tidegate.cameras"
BEAM_LINES = "tidegate.beam_lines"
NOT_HASHED = frozenset({"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"})


class PlugInError(TidegateError):
    """A plug-in is missing, is not the one that the site names, or is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlugIn:
    """An installed plug-in.

    Attributes
    ----------
    group, name
        Its entry point.
    distribution, version
        What installed it.
    sha256
        Of its distribution's files; empty where they lie elsewhere (installed for editing).
    """

    group: str
    name: str
    distribution: str
    version: str
    sha256: str
    entry: EntryPoint

    @property
    def label(self) -> str:
        """The words for a person."""
        return f"{self.distribution} {self.version}"

    def load(self) -> object:
        """Import it; raise PlugInError where that fails, or where its module would come from elsewhere."""
        spec = find_spec(self.entry.module.partition(".")[0])
        origin = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        files = [] if self.entry.dist is None else self.entry.dist.files or []
        if self.sha256 and origin not in {Path(str(one.locate())).resolve() for one in files}:
            msg = f"the plug-in {self.name} would be imported from {origin}, which is no file of {self.label}"
            raise PlugInError(msg)
        try:
            return self.entry.load()
        except Exception as error:
            msg = f"the plug-in {self.name} ({self.label}) cannot be imported: {type(error).__name__}: {error}"
            raise PlugInError(msg) from error


def find_plug_ins(group: str) -> tuple[PlugIn, ...]:
    """Return what is installed in a group, by name; raise PlugInError where two have the same name."""
    found: dict[str, PlugIn] = {}
    for entry in sorted(entry_points(group=group), key=lambda one: one.name):
        if entry.dist is None:
            continue
        one = PlugIn(
            group=group,
            name=entry.name,
            distribution=entry.dist.name,
            version=entry.dist.version,
            sha256=_sha256(entry.dist),
            entry=entry,
        )
        other = found.setdefault(entry.name, one)
        if (other.distribution, other.version) != (one.distribution, one.version):
            msg = f"{other.label} and {one.label} both have {group} {entry.name}: remove one"
            raise PlugInError(msg)
    return tuple(found.values())


def allowed_plug_ins(group: str, allowed: Mapping[str, str] | None) -> tuple[PlugIn, ...]:
    """Return the plug-ins of a group that may run.

    Parameters
    ----------
    allowed
        Names and hashes that the site lists; None allows every installed one.

    Raises
    ------
    PlugInError
        A listed one has another hash.
    """
    found = find_plug_ins(group)
    if allowed is None:
        return found
    for one in found:
        if one.name in allowed and one.sha256 != allowed[one.name]:
            has = one.sha256 or "none, because it is installed for editing"
            msg = f"site.plug_ins lists {one.name}={allowed[one.name]}, but the SHA-256 of {one.label} is {has}"
            raise PlugInError(msg)
    return tuple(one for one in found if one.name in allowed)


def find_plug_in(group: str, name: str, allowed: Mapping[str, str] | None) -> PlugIn:
    """Return one plug-in; raise PlugInError where it is not installed, or not allowed."""
    one = next((one for one in allowed_plug_ins(group, allowed) if one.name == name), None)
    if one is not None:
        return one
    there = next((one for one in find_plug_ins(group) if one.name == name), None)
    if there is None:
        msg = f"no installed distribution has {group} {name}"
    else:
        msg = f"site.plug_ins does not list {name}: {there.label} may run once it has {name}={there.sha256 or '...'}"
    raise PlugInError(msg)


def _sha256(distribution: Distribution) -> str:
    digest, is_code_here = hashlib.sha256(), False
    for path in sorted(distribution.files or (), key=str):
        where = distribution.locate_file(path)
        if path.name in NOT_HASHED or path.suffix in {".pyc", ".pth"} or not where.is_file():  # type: ignore[attr-defined]
            continue
        is_code_here |= ".dist-info" not in str(path.parent)
        digest.update(f"{path}\0".encode() + hashlib.sha256(path.read_binary()).digest())
    return digest.hexdigest() if is_code_here else ""
