"""How the programs of this package speak and end."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable


class Failed(Exception):
    """What cannot be done, in words."""


def say(line: str) -> None:
    """Says something, if there still is a reader: what a program is for goes on without one."""
    _print(line, sys.stdout)


def warn(line: str) -> None:
    """Says something beside a program's result."""
    _print(line, sys.stderr)


def _print(line: str, to: object) -> None:
    try:
        print(line, file=to, flush=True)
    except OSError:
        # What is left in the buffer would be an error at the program's end.
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, to.fileno())
        os.close(nothing)


def run_command(act: Callable[[], None]) -> int:
    """Does what a program is for; its exit code."""
    try:
        act()
    except Failed as error:
        warn(f"error: {error}")
        return 1
    except KeyboardInterrupt:
        return 130
    return 0
