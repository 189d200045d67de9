from .workspace import COLLECT as COLLECT
from .workspace import CollectWorkspace as CollectWorkspace
