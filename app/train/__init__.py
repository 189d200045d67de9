"""The Train workspace: train models, compare them, put one in use."""
