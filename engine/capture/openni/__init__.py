"""OpenNI2 cameras: the C interface, the device, its frames, and the depth source made of them."""
