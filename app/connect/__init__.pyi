from .presenter import BenchDialogs as BenchDialogs
