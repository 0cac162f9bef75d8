"""Accuracy and timing of the gate's edges against the true phase."""
