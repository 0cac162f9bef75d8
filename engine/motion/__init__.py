"""Measures motion in mm from RGB-D frames: stages, breathing, learning, tracking and the pipeline."""
