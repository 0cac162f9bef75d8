"""The engine in a process of its own, for `tidegate serve`: the service cannot take the interpreter lock from it.

`process_engine`, `remote_engine`, `standby` and `child_process` are the service's side, `engine_server` the engine's;
`channels`, `messages` and `shared_page` belong to both. docs/adr/0015 gives the reasons and the cost.
"""
