"""Qt views: they show values and report intent; no device, no file, no thread."""
