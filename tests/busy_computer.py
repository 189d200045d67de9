"""What a computer that does not keep up brings about in real time, by the codes of its faults.

A test that runs drivers and emulated devices beside other tests may meet each of these; the
operator reads the next step, resets and goes on, and so does the test (docs/hardware.md).
"""

STREAM_LOST = frozenset({"PRESS-VOID", "MXT-LOST", "MXT-ENDED", "MXT-START", "CONTROLLER"})
"""The stream of the arm came too late, or never began."""
ORDERS_LATE = frozenset({"BACKEND-SILENT", "CONTROL-LOST", "LEASE-LAPSED", "NO-LEASE"})
"""What had to be renewed in time was not."""
SAMPLES_LATE = frozenset({"TARE-REFUSED", "NO-REFERENCE", "FT-STALE", "CAMERA-STALE", "GRIP-STALE"})
"""Samples came in bursts or not at all: they are no measurement."""
GIVEN_UP = frozenset({"FT-LINK", "CAMERA-LINK", "WSG-LINK", "ARM-LINK", "ARM-STALE"})
"""A link on which nothing came for long."""
STARVED = STREAM_LOST | ORDERS_LATE | SAMPLES_LATE | GIVEN_UP
