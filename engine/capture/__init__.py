"""Frame sources and recorders: the source role, OpenNI2 devices, ``.oni`` recordings."""
