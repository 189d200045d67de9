from .driver import make_lerobot as make_lerobot

__all__ = ["make_lerobot"]
