"""The bundle for a hospital without internet: made, signed, and installed in a network namespace without a network."""
