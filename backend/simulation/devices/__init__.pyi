from .bench import BenchStreams as BenchStreams
from .bench import SimulatedBench as SimulatedBench
