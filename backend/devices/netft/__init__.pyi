from .driver import NetFtDriver as NetFtDriver
from .emulator import emulate_netft as emulate_netft

__all__ = [
    "NetFtDriver",
    "emulate_netft",
]
