from .workspace import TrainWorkspace as TrainWorkspace
