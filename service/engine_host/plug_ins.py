"""The plug-ins that a site's settings let run: cameras and the beam line of other distributions."""

from functools import cache

from engine.capture import drivers
from engine.core.plug_ins import BEAM_LINES, CAMERAS, PlugIn, allowed_plug_ins, find_plug_in
from service.core.settings.beam import BeamSettings


def use_plug_ins(settings: BeamSettings) -> tuple[PlugIn, ...]:
    """Load the cameras' drivers, once a process; return every plug-in in use.

    Raises
    ------
    PlugInError
        A plug-in is missing, cannot be loaded, or is not the one that the site lists.
    """
    allowed = settings.allowed_plug_ins
    return _used(None if allowed is None else tuple(sorted(allowed.items())), settings.beam_plug_in.partition(":")[0])


def described(plug_in: PlugIn) -> str:
    """Return a plug-in's distribution, version, name and hash in one phrase."""
    return f"{plug_in.label}: {plug_in.name}={plug_in.sha256}"


@cache  # what was found at the start holds for the process
def _used(allowed: tuple[tuple[str, str], ...] | None, beam_line: str) -> tuple[PlugIn, ...]:
    listed = None if allowed is None else dict(allowed)
    cameras = allowed_plug_ins(CAMERAS, listed)
    drivers.add_cameras(cameras)
    return (*cameras, find_plug_in(BEAM_LINES, beam_line, listed)) if beam_line else cameras
