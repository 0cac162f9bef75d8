"""The outermost middleware: stamps the time at which a request arrived, see `service.core.request_time`."""

from starlette.types import ASGIApp, Receive, Scope, Send

from service.core.request_time import arriving_now


class Arrival:
    """Stamps each HTTP request before it can wait; the route's thread inherits the context."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Stamp an HTTP request and pass it on; pass everything else on as it is."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        with arriving_now():
            await self._app(scope, receive, send)
