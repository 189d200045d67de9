from .driver import WsgGripper as WsgGripper
from .emulator import EmulatedGcl as EmulatedGcl
from .emulator import EmulatedWsg as EmulatedWsg
from .gcl import Assignment as Assignment
from .gcl import GclProtocol as GclProtocol
from .gcl import Query as Query
from .gcl import encode as encode
from .gcl import lines as lines
from .protocol import BinaryProtocol as BinaryProtocol
from .protocol import GripperProtocol as GripperProtocol
from .protocol import WsgCommand as WsgCommand
from .protocol import WsgReply as WsgReply
from .protocol import WsgRequest as WsgRequest
from .protocol import encode_request as encode_request
from .protocol import replies as replies

__all__ = [
    "Assignment",
    "BinaryProtocol",
    "EmulatedGcl",
    "EmulatedWsg",
    "GclProtocol",
    "GripperProtocol",
    "Query",
    "WsgCommand",
    "WsgGripper",
    "WsgReply",
    "WsgRequest",
    "encode",
    "encode_request",
    "lines",
    "replies",
]
