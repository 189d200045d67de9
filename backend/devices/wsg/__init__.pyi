from .emulator import EmulatedWsg as EmulatedWsg

__all__ = ["EmulatedWsg"]
