"""Quality assurance: what is measured of camera, motion, gate and beam line, and whether that is good enough."""
