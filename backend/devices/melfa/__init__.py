"""The driver of a MELFA arm: command channel, real-time stream, and compliance in software."""
