"""The engine in a process of its own, for `tidegate serve`: nothing the service does takes the interpreter from it.

`remote` and `standby` are the service's side, `serving` is the engine's, `crossing`, `messages` and `page` are what
both know. docs/adr/0015 says why, and what it costs.
"""
