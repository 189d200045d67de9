"""Universal Robots arm over RTDE."""
