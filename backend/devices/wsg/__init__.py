"""Driver of Weiss WSG grippers."""
