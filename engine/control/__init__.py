"""The engine thread: loop, watchdog, gate controller, command and output queues, transition journal."""
