from .workspace import OperateWorkspace as OperateWorkspace
