from .presenter import BenchDialogs as BenchDialogs

__all__ = ["BenchDialogs"]
