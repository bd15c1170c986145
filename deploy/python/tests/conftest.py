"""Runs that the tests act with, made by the installed program."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

#: The program that came with the package.
RIT = str(Path(sys.executable).parent / "rit")
REPOSITORY = Path(__file__).resolve().parents[3]


def rit(*arguments, check=True, **options):
    """Runs the program and returns what became of it."""
    done = subprocess.run([RIT, *map(str, arguments)], capture_output=True, text=True, timeout=300, **options)
    if check and done.returncode != 0:
        pytest.fail(f"rit {arguments}: exit code {done.returncode}\n{done.stderr}")
    return done


def train(folder, experiment, *arguments):
    """Trains quietly to the end; the run directory and the summary."""
    run = folder / "run"
    done = rit("train", experiment, "--json", "--run-dir", run, "--actors", 1, "--set", "web.listen=off", *arguments)
    return run, json.loads(done.stdout)


@pytest.fixture(scope="session")
def matrix_run(tmp_path_factory):
    """A short run of the matrix game whose agents decide in their own order."""
    run, _ = train(
        tmp_path_factory.mktemp("matrix"),
        "matrix-game",
        *("--steps", 400, "--seed", 3),
        *("--set", "algorithm.random_permutation=false"),
        *("--set", "evaluation.episodes=2", "--set", "checkpoints.every_env_steps=200"),
    )
    return run
