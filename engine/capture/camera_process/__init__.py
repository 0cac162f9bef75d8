"""A camera whose SDK runs in a process of its own, which is killed where a call of the SDK hangs or crashes.

`source` is the engine's side and a :class:`engine.capture.source.LiveSource`; `server` runs in the other process, with
the one module that imports the SDK. Pictures pass through shared memory, all else through a socket.
"""
