"""One dataset folder: its index, its labels with their whole history, and what keeps them safe."""
