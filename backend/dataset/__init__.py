"""Episodes and run journals on disk."""
