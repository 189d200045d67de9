"""The Stack workspace: one piece stacked by touch, seen, judged and approved."""
