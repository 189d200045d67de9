from .driver import make_ur as make_ur
from .rtde import UrWrenchDriver as UrWrenchDriver

__all__ = [
    "UrWrenchDriver",
    "make_ur",
]
