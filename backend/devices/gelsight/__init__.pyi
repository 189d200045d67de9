from .protocol import JpegStream as JpegStream
from .protocol import decode as decode
from .protocol import size_px as size_px
from .protocol import tables as tables

__all__ = ["JpegStream", "decode", "size_px", "tables"]
