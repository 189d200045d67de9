"""From raw samples to marker fields and episodes."""
