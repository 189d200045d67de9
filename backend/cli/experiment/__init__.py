"""backend/cli/experiment."""
