from .workspace import StackWorkspace as StackWorkspace

__all__ = ["StackWorkspace"]
