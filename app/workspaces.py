"""The workspaces of the window, in the order of the rail."""

from __future__ import annotations

from collections.abc import Callable

from app.collect.workspace import CollectWorkspace
from app.operate.workspace import OperateWorkspace
from app.review.workspace import ReviewWorkspace
from app.stack.workspace import StackWorkspace
from app.train.workspace import TrainWorkspace
from app.workspace import Desk, Workspace

WORKSPACES: tuple[Callable[[Desk], Workspace], ...] = (
    OperateWorkspace,
    CollectWorkspace,
    TrainWorkspace,
    StackWorkspace,
    ReviewWorkspace,
)
FIRST = "stack"
"""In front at the first start."""
