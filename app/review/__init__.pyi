from .workspace import ReviewWorkspace as ReviewWorkspace
