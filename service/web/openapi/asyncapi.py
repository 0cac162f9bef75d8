"""The AsyncAPI 3.0 document of the live stream, both transports, and of the coaching stream; with examples."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from engine import __version__
from service.core.permissions import Permission
from service.core.schemas import coach_messages, live_messages
from service.web.openapi.components import SECURITY_SCHEMES
from service.web.stream.examples import EXAMPLES
from service.web.stream.query import EventsQuery, LiveQuery

MESSAGES: tuple[type[live_messages.Message], ...] = (
    live_messages.Hello,
    live_messages.Idle,
    live_messages.Ping,
    live_messages.Dropped,
    live_messages.Gap,
    live_messages.Resumed,
    live_messages.Alarms,
    live_messages.Sample,
    live_messages.ThinSample,
    live_messages.RecordedSample,
)
COACH_MESSAGES: tuple[type[coach_messages.CoachMessage], ...] = (
    coach_messages.CoachHello,
    coach_messages.CoachWait,
    coach_messages.CoachGuide,
)
SCHEMAS = "#/components/schemas/{model}"
WAYS = {
    "live": ("/api/v1/live", "WebSocket: each message is a text frame, or a binary frame with msgpack"),
    "events": (
        "/api/v1/live/events",
        "Server-sent events: `event` is the message type, `data` the message as JSON, `id` the frame",
    ),
    "coach": ("/api/v1/coach/live", "WebSocket of patient screens: places, words, no lengths, names or ids"),
}


def asyncapi_document() -> dict[str, Any]:
    """Return the AsyncAPI document."""
    _, described = models_json_schema(
        [
            *((kind, "serialization") for kind in (*MESSAGES, *COACH_MESSAGES)),
            *((kind, "validation") for kind in (LiveQuery, EventsQuery)),
        ],
        ref_template=SCHEMAS,
    )
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Tidegate live stream",
            "version": __version__,
            "description": "Measurements and gate decisions of the running session; docs/4-integrate/stream.md "
            "explains each message. **Not cleared for clinical use.**",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": "application/json",
        "servers": {
            "room": {"host": "localhost:8000", "protocol": "ws", "security": _security()},
            "room-events": {"host": "localhost:8000", "protocol": "http", "security": _security()},
        },
        "channels": {name: _channel(name) for name in WAYS},
        "operations": {f"watch_{name}": _operation(name) for name in WAYS},
        "components": {
            "schemas": described["$defs"],
            "messages": {kind.__name__: _message(kind) for kind in (*MESSAGES, *COACH_MESSAGES)},
            "securitySchemes": _security_schemes(),
        },
    }


def _messages(name: str) -> tuple[type[BaseModel], ...]:
    return COACH_MESSAGES if name == "coach" else MESSAGES


def _channel(name: str) -> dict[str, Any]:
    address, description = WAYS[name]
    channel = {
        "address": address,
        "description": description,
        "servers": [{"$ref": f"#/servers/{'room-events' if name == 'events' else 'room'}"}],
        "messages": {kind.__name__: {"$ref": f"#/components/messages/{kind.__name__}"} for kind in _messages(name)},
        "bindings": {},
        "x-permission": str(Permission.COACH_WATCH if name == "coach" else Permission.SESSIONS_READ),
    }
    if name == "coach":
        return channel
    query = {"$ref": SCHEMAS.format(model=(LiveQuery if name == "live" else EventsQuery).__name__)}
    bindings = {"ws": {"method": "GET", "query": query}} if name == "live" else {}
    return channel | {"bindings": bindings, "x-query": query}


def _operation(name: str) -> dict[str, Any]:
    """Describe the operation from the application's side, as AsyncAPI requires: it sends."""
    return {
        "action": "send",
        "channel": {"$ref": f"#/channels/{name}"},
        "summary": "All messages that a client receives",
        "messages": [{"$ref": f"#/channels/{name}/messages/{kind.__name__}"} for kind in _messages(name)],
    }


def _message(kind: type[BaseModel]) -> dict[str, Any]:
    name = kind.__name__
    return {
        "name": EXAMPLES[name]["type"],
        "title": name,
        "summary": (kind.__doc__ or "").strip().splitlines()[0],
        "payload": {"$ref": SCHEMAS.format(model=name)},
        "examples": [{"name": name, "payload": EXAMPLES[name]}],
    }


def _security() -> list[dict[str, str]]:
    return [{"$ref": f"#/components/securitySchemes/{name}"} for name in SECURITY_SCHEMES]


def _security_schemes() -> dict[str, Any]:
    """Convert the security schemes: OpenAPI's apiKey in a cookie is AsyncAPI's httpApiKey."""
    return {
        name: {**scheme, "type": "httpApiKey"} if scheme["type"] == "apiKey" else scheme
        for name, scheme in SECURITY_SCHEMES.items()
    }
