"""The label half of the workspace "Collect & Label": one displacement per episode, by keyboard."""
