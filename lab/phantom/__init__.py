"""The virtual volunteer: a breathing torso, seen by a camera with every fault of the real one."""
