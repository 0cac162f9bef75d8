"""FastAPI works out each route's dependencies and models once a process here, not twice an application.

A service has two hundred tests a file that each start an application of their own, and what FastAPI works out for its
routes is the same for all of them: it follows from the route and from how its router was included. That it takes two
thirds of such a test's time is why this reaches into FastAPI. Nothing overrides dependencies here: that alone would
tell two applications apart.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
from fastapi import routing


@contextmanager
def routes_once() -> Iterator[None]:
    """Keep what is worked out for a route, until the block ends."""
    work_out = routing._IncludedRouter._build_effective_context
    kept: dict[int, list[tuple[Any, Any, Any]]] = {}

    def kept_or_worked_out(included: Any, route: Any) -> Any:
        how = replace(included.include_context, dependency_overrides_provider=None)
        known = kept.setdefault(id(route), [])
        for _, told, found in known:
            if told == how:
                return found
        known.append((route, how, work_out(included, route)))  # the route is kept, too: so is its id
        return known[-1][-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(routing._IncludedRouter, "_build_effective_context", kept_or_worked_out)
        yield
