"""What arms share whose motions this computer streams: contact law, moves, presses."""
