from .finite_gel import FiniteGelTrials as FiniteGelTrials
from .finite_gel import import_skfem as import_skfem
from .trials import SecondWorldTrials as SecondWorldTrials
