"""A simulated planning and record-and-verify system, to run whole fractions over HTTP as a real one would."""
