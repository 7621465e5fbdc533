"""Ctrl-C ends a command soon, with one line, wherever it is."""

import os
import signal
import subprocess
import sys
import time

# A command whose workers sleep; the parent waits for them.
WORKERS = """
import sys, time
sys.argv[0] = "vrrt"
from vrrt_jax.core import command
from vrrt_jax.core.workers import in_workers

def work(_):
    print("working", flush=True)
    time.sleep(600)

def run(arguments):
    list(in_workers(work, range(2), 2))

if __name__ == "__main__":
    parser = command.Parser(prog="vrrt")
    parser.add_subparsers(dest="command").add_parser("sleep").set_defaults(run=run)
    raise SystemExit(command.run(parser, ["sleep"]))
"""
# A command inside a library, which hears of no signal; it has told what is done.
DEAF = """
import hashlib, sys
sys.argv[0] = "vrrt"
from vrrt_jax.core import command

def run(arguments):
    print("working", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)

parser = command.Parser(prog="vrrt")
parser.add_subparsers(dest="command").add_parser("hash").set_defaults(run=run)
raise SystemExit(command.run(parser, ["hash"]))
"""
# A command that is hit where an exception is lost: in what Python runs when it forgets something.
LOSING = """
import sys, time
sys.argv[0] = "vrrt"
from vrrt_jax.core import command

class Slow:
    def __del__(self):
        print("working", flush=True)
        time.sleep(600)

def run(arguments):
    Slow()
    time.sleep(600)

parser = command.Parser(prog="vrrt")
parser.add_subparsers(dest="command").add_parser("forget").set_defaults(run=run)
raise SystemExit(command.run(parser, ["forget"]))
"""
# A command that imports its modules; it tells when it has begun to listen.
STARTING = """
import signal, sys, time
sys.argv[0] = "nrp"
listen = signal.signal

def tell(*args):
    listen(*args)
    print("working", flush=True)

signal.signal = tell
import nrp_jax.cli

time.sleep(600)
"""


def interrupt(code, tmp_path, after=0.0):
    """Ctrl-C as a terminal sends it: exit code, seconds until the end, lines that were told."""
    script = tmp_path / "command.py"
    script.write_text(code)
    run = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert run.stdout is not None and run.stderr is not None
        first = run.stdout.readline()
        # A command that came to an end instead says why.
        assert first == "working\n", first or run.stderr.read()
        time.sleep(after)
        began = time.monotonic()
        os.killpg(run.pid, signal.SIGINT)
        _, told = run.communicate(timeout=60)
        return run.returncode, time.monotonic() - began, told.splitlines()
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)


def test_a_command_ends_that_hears_of_no_signal(tmp_path):
    code, seconds, told = interrupt(DEAF, tmp_path)
    assert code == 130 and seconds < 10 and told == ["vrrt hash: interrupted"]


def test_of_an_interrupt_that_is_lost_nothing_is_told(tmp_path):
    code, seconds, told = interrupt(LOSING, tmp_path)
    assert code == 130 and seconds < 10 and told == ["vrrt forget: interrupted"]


def test_workers_say_nothing(tmp_path):
    code, seconds, told = interrupt(WORKERS, tmp_path, after=0.2)
    assert code == 130 and seconds < 10 and told == ["vrrt sleep: interrupted"]


def test_while_modules_are_imported(tmp_path):
    code, seconds, told = interrupt(STARTING, tmp_path, after=0.5)
    assert code == 130 and seconds < 10 and told == ["nrp: interrupted"]
