from .emulator import EmulatedDynpick as EmulatedDynpick
