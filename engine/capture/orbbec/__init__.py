"""Orbbec cameras (Gemini, Femto) through OrbbecSDK v2: `driver` for the engine, `camera` for the camera's process."""
