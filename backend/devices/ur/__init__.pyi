from .driver import UrArm as UrArm
from .rtde import SCHEME as SCHEME
from .rtde import UrWrenchDriver as UrWrenchDriver
from .rtde import open_rtde as open_rtde

__all__ = ["SCHEME", "UrArm", "UrWrenchDriver", "open_rtde"]
