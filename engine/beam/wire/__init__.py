"""Beam lines on a wire (Modbus, serial relay): exchange, supervision and settings."""
