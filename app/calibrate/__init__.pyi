from .presenter import CalibratePresenter as CalibratePresenter
