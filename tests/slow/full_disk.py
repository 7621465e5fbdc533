"""A disk that is full: one line says so, what was done is kept, and goes on once there is room.

Run ``python -m tests.slow.full_disk`` as root: each command writes to small disks in memory (tmpfs)
that fill at different moments.
"""

import argparse
import subprocess
from pathlib import Path

from .commands import Command, start, told_file, try_all
from .kill import fresh, kept, undisturbed


def used_kib(folder: Path) -> int:
    """Room that files take on a disk in memory [KiB], whose blocks are 4 KiB."""
    return sum(4 * -(-f.stat().st_size // 4096) for f in folder.rglob("*") if f.is_file())


def filled(command: Command, shared: Path, shares: list[float]) -> tuple[str, list[str]]:
    """Run a command on disks with a share of the room it needs: how it ended, what was wrong."""
    undisturbed(command, shared / "whole")
    expected, need = command.result(shared / "whole"), used_kib(shared / "whole")
    wrong, full = [], 0
    for share in shares:
        folder = fresh(shared / "disk")
        size = max(8, int(share * need))
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", folder], check=True)
        try:
            code = start(command, folder).wait(timeout=600)
            told = [line for line in told_file(folder).read_text().splitlines() if line.strip()]
            told = [line for line in told if "\r" not in line and "it/s" not in line]
            before = kept(command, folder, {})
            if code != 0:
                full += 1
                if code != 2 or "disk" not in told[-1] or any("Traceback" in t for t in told):
                    wrong.append(f"{size} KiB: code {code}, {told[-3:]}")
            subprocess.run(["mount", "-o", f"remount,size={4 * need + 4096}k", folder], check=True)
            if start(command, folder).wait(timeout=600) != 0:
                wrong.append(f"{size} KiB, then more: {told_file(folder).read_text()[-300:]}")
                continue
            kept(command, folder, before)
            if command.result(folder) != expected:
                wrong.append(f"{size} KiB: the results differ from those of a whole run")
        except AssertionError as error:
            wrong.append(f"{size} KiB: {error}")
        finally:
            subprocess.run(["umount", "-l", folder], check=True)
    return f"{full} of {len(shares)} disks of {need} KiB and less were full", wrong


def main() -> int:
    """Fill all disks; ends with 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shares", default="0.1,0.3,0.5,0.7,0.9", help="of the room needed")

    def attempt(command, shared, arguments):
        return filled(command, shared, [float(share) for share in arguments.shares.split(",")])

    return try_all(parser, attempt)


if __name__ == "__main__":
    raise SystemExit(main())
