from .executors import add_device as add_device
from .executors import add_executor_arguments as add_executor_arguments
from .executors import run_jobs as run_jobs
