"""Supervision over several frames: repeated frames, patient shift, model age, operator presence."""
