"""The Review workspace: recorded runs told again."""
