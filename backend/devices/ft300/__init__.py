"""Robotiq FT 300 sensor."""
