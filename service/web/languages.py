"""The languages of the page: the files of ``dashboard/lang``, listed for the page; a new language is a new file."""

import re
from pathlib import Path

from starlette.responses import JSONResponse, Response
from starlette.routing import Route

LANGUAGE_LIST = "/lang/index.json"
_NAME = re.compile(r"[a-z]{2}(-[A-Z]{2})?")


def language_names(dashboard: Path) -> list[str]:
    """Return the languages that have a file, in alphabetical order; files with other names are none."""
    return sorted(file.stem for file in (dashboard / "lang").glob("*.json") if _NAME.fullmatch(file.stem))


def language_route(dashboard: Path) -> Route:
    """Make the route that lists the languages to the page."""
    names = language_names(dashboard)

    async def listed(_: object) -> Response:
        return JSONResponse({"languages": names})

    return Route(LANGUAGE_LIST, listed, name="languages")
