from .workspace import ReviewWorkspace as ReviewWorkspace

__all__ = ["ReviewWorkspace"]
