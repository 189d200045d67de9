"""Every setting, typed at the edge."""
