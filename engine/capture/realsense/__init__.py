"""Intel RealSense D4xx (active stereo) through librealsense: `driver` for the engine, `camera` for its process."""
