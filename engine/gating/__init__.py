"""May the beam be on: the gate's reducer, frame checks, limits, windows and supervision."""
