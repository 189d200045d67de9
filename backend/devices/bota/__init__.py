"""Bota Systems SensONE sensor."""
