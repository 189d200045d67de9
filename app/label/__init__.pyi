from .workspace import HalvesPage as HalvesPage
from .workspace import LabelWorkspace as LabelWorkspace

__all__ = ["HalvesPage", "LabelWorkspace"]
