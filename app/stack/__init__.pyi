from .workspace import StackWorkspace as StackWorkspace
