"""Names of the formats that experiments write, each in its file's ``format``."""

TABLES_FORMAT = "touchdown-tables/1"
BEYOND_FORMAT = "touchdown-beyond/2"
BEYOND_READABLE = ("touchdown-beyond/1", BEYOND_FORMAT)
"""The first says nothing of towers that were left out."""
