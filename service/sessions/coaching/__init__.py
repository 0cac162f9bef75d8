"""What a patient screen shows of the running session, from the engine's view; the engine reads nothing of it."""
