from .trials import SecondWorldTrials as SecondWorldTrials

__all__ = ["SecondWorldTrials"]
