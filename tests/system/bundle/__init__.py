"""The installer of the bundle without internet: what it refuses, and in which order it upgrades and goes back."""
