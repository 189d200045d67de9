from .arm import UrArm as UrArm
from .force_sensor import SCHEME as SCHEME
from .force_sensor import UrLanguage as UrLanguage
from .force_sensor import open_rtde as open_rtde

__all__ = ["SCHEME", "UrArm", "UrLanguage", "open_rtde"]
