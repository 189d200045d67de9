"""Physics of the simulated bench: functions of state, no thread, no wall clock."""
