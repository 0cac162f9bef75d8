"""Making a calibration: from pictures of a checkerboard, and from recordings of a flat plate; how good it is, in mm."""
