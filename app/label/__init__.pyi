from .workspace import Halves as Halves
from .workspace import LabelWorkspace as LabelWorkspace

__all__ = ["Halves", "LabelWorkspace"]
