"""Memory that stays: asked of the system itself, in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

TOLD = """
from pathlib import Path
from touchdown.backend.rig.memory import lock_memory
kept = lock_memory()
lines = Path("/proc/self/status").read_text().splitlines()
(locked,) = [int(line.split()[1]) for line in lines if line.startswith("VmLck")]
later = bytearray(32 << 20)
print(kept, locked)
"""
ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps memory of a process")
@pytest.mark.parametrize("limit_kib", [None, 8192])
def test_memory_is_kept_where_that_is_allowed_and_nothing_breaks_where_not(limit_kib):
    command = [sys.executable, "-c", TOLD]
    if limit_kib is not None:
        drop = 'ulimit -l $0 && exec setpriv --bounding-set=-all --reuid=65534 --clear-groups "$@"'
        ordinary = ["sh", "-c", drop, str(limit_kib)]
        if subprocess.run([*ordinary, sys.executable, "-c", ""], cwd=ROOT, check=False).returncode:
            pytest.skip("only a superuser can try what an ordinary user may, with a Python for all")
        command = [*ordinary, *command]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    kept, locked_kib = done.stdout.split()
    assert (kept == "True") == (int(locked_kib) > 8192)
    if limit_kib is not None:
        assert kept == "False"
