"""Everything around the engine: HTTP, WebSocket, database, command line and page."""
