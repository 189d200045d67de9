from .driver import make_gripper as make_gripper
from .emulator import EmulatedWsg as EmulatedWsg
from .emulator_gcl import EmulatedGcl as EmulatedGcl
from .protocol import Command as Command
from .protocol import Reply as Reply
from .protocol import Request as Request
from .protocol import encode_request as encode_request
from .protocol import replies as replies
from .protocol_gcl import Assignment as Assignment
from .protocol_gcl import Query as Query
from .protocol_gcl import encode as encode
from .protocol_gcl import lines as lines

__all__ = [
    "Assignment",
    "Command",
    "EmulatedGcl",
    "EmulatedWsg",
    "Query",
    "Reply",
    "Request",
    "encode",
    "encode_request",
    "lines",
    "make_gripper",
    "replies",
]
