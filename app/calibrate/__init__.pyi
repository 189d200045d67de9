from .presenter import CalibratePresenter as CalibratePresenter

__all__ = ["CalibratePresenter"]
