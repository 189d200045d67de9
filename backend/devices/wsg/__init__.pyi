from .emulator import EmulatedWsg as EmulatedWsg
