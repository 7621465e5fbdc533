"""What the command lines share."""

import signal
import subprocess
import sys
import time
from pathlib import Path

# A parent that starts a worker, tells its number and waits.
PARENT = """
import multiprocessing, time
from vrrt_jax.core.command import end_with_parent

def work():
    end_with_parent()
    print(multiprocessing.current_process().pid, flush=True)
    time.sleep(600)

if __name__ == "__main__":
    worker = multiprocessing.get_context("spawn").Process(target=work)
    worker.start()
    worker.join()
"""


def test_workers_end_when_their_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = Path("/proc") / parent.stdout.readline().strip()
    assert worker.name.isdigit() and _runs(worker)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    waited_until = time.monotonic() + 30
    while _runs(worker):
        assert time.monotonic() < waited_until, "the worker outlives its parent"
        time.sleep(0.1)


def _runs(process: Path) -> bool:
    """Whether a process exists and is no zombie that nobody has asked about."""
    try:
        return (process / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
