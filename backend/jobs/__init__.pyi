from .cluster import DaskCluster as DaskCluster
from .execution import Executor as Executor
from .execution import ProcessPool as ProcessPool
from .execution import SerialExecutor as SerialExecutor
from .execution import independent_jobs as independent_jobs
from .execution import parse_shard as parse_shard
from .execution import run_campaign as run_campaign
from .execution import shard_of as shard_of
from .job import SPEC_FILE as SPEC_FILE
from .job import JobContext as JobContext
from .job import JobFunctions as JobFunctions
from .job import JobSpec as JobSpec
from .job import JobStore as JobStore
from .sources import lazy_exports as lazy_exports
from .sources import source_hash as source_hash

__all__ = [
    "SPEC_FILE",
    "DaskCluster",
    "Executor",
    "JobContext",
    "JobFunctions",
    "JobSpec",
    "JobStore",
    "ProcessPool",
    "SerialExecutor",
    "independent_jobs",
    "lazy_exports",
    "parse_shard",
    "run_campaign",
    "shard_of",
    "source_hash",
]
