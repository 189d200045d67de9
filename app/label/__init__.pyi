from .workspace import HalvesPage as HalvesPage
from .workspace import LabelWorkspace as LabelWorkspace
