"""A socket that the server has closed by itself, before the stream has seen the client's disconnection."""

import anyio
import pytest
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from service.web.stream.encoding import Form, Shape
from service.web.stream.transports import SocketConnection

CLOSED = "Unexpected ASGI message 'websocket.send', after sending 'websocket.close'."


async def never():
    raise AssertionError("nothing is received")


async def refuse(_message):
    raise RuntimeError(CLOSED)


def test_sending_on_a_socket_that_the_server_closed_is_a_disconnection():
    """uvicorn closes it at a protocol error; the next send raised RuntimeError, and the log had a traceback."""
    websocket = WebSocket({"type": "websocket", "extensions": {}}, never, refuse)
    websocket.client_state = websocket.application_state = WebSocketState.CONNECTED
    sending = SocketConnection(websocket, Shape("websocket", Form.FULL)).send("x")
    with pytest.raises(WebSocketDisconnect) as caught:
        sending.send(None)
    assert caught.value.code == 1006


def test_closing_a_socket_that_the_server_closed_states_nothing():
    websocket = WebSocket({"type": "websocket", "extensions": {}}, never, refuse)
    websocket.client_state = websocket.application_state = WebSocketState.CONNECTED
    anyio.run(SocketConnection(websocket, Shape("websocket", Form.FULL)).close, "stalled")
