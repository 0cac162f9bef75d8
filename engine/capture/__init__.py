"""Frames: the roles of a source and a camera driver, one folder for each SDK, ``.oni`` recordings, recorders."""
