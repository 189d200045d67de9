from .emulator import EmulatedDynpick as EmulatedDynpick

__all__ = ["EmulatedDynpick"]
