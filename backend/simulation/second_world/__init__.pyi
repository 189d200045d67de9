from .trials import SecondWorldTrials as SecondWorldTrials
