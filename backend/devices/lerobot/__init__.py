"""Cameras of LeRobot as a plug-in."""
