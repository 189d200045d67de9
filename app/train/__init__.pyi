from .workspace import TrainWorkspace as TrainWorkspace

__all__ = ["TrainWorkspace"]
