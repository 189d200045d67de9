from .presenter import BenchPanels as BenchPanels

__all__ = ["BenchPanels"]
