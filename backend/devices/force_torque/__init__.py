"""Drivers of wrist force/torque sensors."""
