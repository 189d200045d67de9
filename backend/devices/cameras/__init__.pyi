from .registry import make_tactile as make_tactile
from .system import find_cameras as find_cameras

__all__ = ["find_cameras", "make_tactile"]
