from .output import VerbOutput as VerbOutput

__all__ = ["VerbOutput"]
