"""Everything a run depends on, as the JSON text that its first fact carries."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict

from backend.config.method import StackSettings
from backend.runs.requests import Request


def record_of(request: Request, method: StackSettings, bench: Mapping[str, object]) -> str:
    """Return request, method and ``bench`` (what the host's check told) as JSON."""
    return json.dumps(
        {"request": asdict(request), "method": method.model_dump(mode="json"), **bench}
    )
