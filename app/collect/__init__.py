"""The Collect half of the workspace "Collect & Label": campaigns on the bench."""
