from .links import Link as Link
from .links import UdpLink as UdpLink
from .links import open_link as open_link
from .protocol import Greeting as Greeting
from .protocol import Language as Language
from .protocol import NotAnsweredError as NotAnsweredError
from .protocol import Reading as Reading
from .protocol import Refusals as Refusals
from .protocol import ask as ask
from .protocol import listen as listen
from .protocol import pause as pause
from .reader import LATE_S as LATE_S
from .reader import ForceTorqueReader as ForceTorqueReader

__all__ = [
    "LATE_S",
    "ForceTorqueReader",
    "Greeting",
    "Language",
    "Link",
    "NotAnsweredError",
    "Reading",
    "Refusals",
    "UdpLink",
    "ask",
    "listen",
    "open_link",
    "pause",
]
