from .workspace import OperateWorkspace as OperateWorkspace

__all__ = ["OperateWorkspace"]
