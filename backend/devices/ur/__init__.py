"""Driver of Universal Robots arms, over the package ``ur_rtde`` (optional)."""
