"""OnRobot OptoForce sensor."""
