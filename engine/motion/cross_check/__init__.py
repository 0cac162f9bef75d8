"""A second estimate of what the camera sees, independent of the motion model: surface, colour and the static scene."""
