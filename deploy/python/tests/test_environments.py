"""Environments in Python, through the whole program."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import RIT, rit

import rit as package

TESTS = Path(__file__).parent
SMALL = """
[environment]
python = "worlds:make"
training_tasks = {training}
testing_tasks = ["4"]
timeout_ms = {timeout_ms}
environments_per_worker = 3

[algorithm]
batch_size = 8
random_permutation = {permutation}
epsilon_anneal_steps = 1000

[network]
hidden_dim = 16

[evaluation]
every_env_steps = 1000000
episodes = 4
testing_episodes = 4
"""


@pytest.fixture(autouse=True)
def from_here(monkeypatch):
    """Workers import what lies in the folder that the program was started in."""
    monkeypatch.chdir(TESTS)


def experiment(folder, training=("2", "3"), timeout_ms=20_000, permutation="true"):
    """An experiment on these tasks."""
    path = folder / "mine.toml"
    path.write_text(
        SMALL.format(training=json.dumps(list(training)), timeout_ms=timeout_ms, permutation=permutation)
    )
    return path


def train(path, run, *arguments, actors=1, **environment):
    """Trains to the end; the summary."""
    done = rit(
        *("train", path, "--json", "--run-dir", run, "--actors", actors, "--seed", 3, "--set", "web.listen=off"),
        *arguments,
        env={**os.environ, **{key: str(value) for key, value in environment.items()}},
    )
    return json.loads(done.stdout)


def of_run(of):
    """Living processes of a run, by the folder that their environment names, with their command lines."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and f"RIT_TEST_RUN={of}".encode() in (entry / "environ").read_bytes():
                found.append((int(entry.name), (entry / "cmdline").read_bytes()))
        except OSError:
            pass
    return found


def workers(of):
    """Those of them that are workers."""
    return [pid for pid, command in of_run(of) if b"rit.worker" in command]


def test_it_trains_and_is_as_deterministic_as_any(tmp_path):
    path = experiment(tmp_path)
    first = train(path, tmp_path / "one", "--steps", 600)
    assert first["ended"] == "finished" and set(first["evaluation"]) == {"2", "3"}
    assert train(path, tmp_path / "two", "--steps", 600, actors=2)["weights_digest"] == first["weights_digest"]
    # The run knows its tasks: it is gone on with, and measured on what it has not seen.
    rit("train", "--resume", tmp_path / "one", "--steps", 650, "--json")
    measured = json.loads(rit("evaluate", "--run", tmp_path / "one", "--tasks", "testing", "--json").stdout)
    assert list(measured["tasks"]) == ["4"]
    policy = package.Policy.load(tmp_path / "one")
    assert policy.feature_names == ["place", "is_agent", "is_beacon"]
    assert policy.action_names == ["left", "stay", "right"]


def test_it_learns(tmp_path):
    path = experiment(tmp_path)
    often = ("--set", "algorithm.n_rollout_threads=2", "--set", "algorithm.target_update_interval=50")
    result = train(path, tmp_path / "run", "--steps", 5000, *often, "--set", "evaluation.episodes=32")["evaluation"]
    script = rit("evaluate", "--experiment", path, "--policy", "script:random", "--episodes", 32, "--json")
    random = json.loads(script.stdout)["tasks"]
    for task in ("2", "3"):
        assert result[task]["mean_return"] > 0.6 * random[task]["mean_return"], (result, random)


def test_a_policy_in_python_acts_as_evaluation_does_to_the_last_bit(tmp_path):
    records = tmp_path / "records"
    records.mkdir()
    tasks = ("recorded-2", "recorded-3")
    path = experiment(tmp_path, training=tasks, permutation="false")
    train(path, tmp_path / "run", "--steps", 600, RIT_TEST_RECORDS=records)
    for record in records.iterdir():
        record.unlink()
    rit(
        *("evaluate", "--run", tmp_path / "run", "--episodes", 8),
        env={**os.environ, "RIT_TEST_RECORDS": str(records)},
    )
    policy = package.Policy.load(tmp_path / "run")
    episodes = list(records.iterdir())
    assert len(episodes) == 16
    for record in episodes:
        episode = np.load(record)
        policy.reset(int(record.name[0]))
        reward = 0.0
        for entities, available, actions, paid in zip(*(episode[name] for name in ("entities", "available", "actions", "rewards"))):
            assert (policy.act(entities, available=available, previous_reward=reward) == actions).all()
            reward = paid


@pytest.mark.parametrize("fault", ["raises", "hangs", "dies", "nan", "mask", "prints", "forks", "daemonises", "returns_twice", "hoards"])
def test_an_episode_that_is_lost_is_rolled_again_and_changes_nothing(tmp_path, fault):
    undisturbed = train(experiment(tmp_path, training=["2"]), tmp_path / "one", "--steps", 300)
    faults = tmp_path / "faults"
    faults.mkdir()
    path = experiment(tmp_path, training=[f"{fault}-2"], timeout_ms=500)
    run = tmp_path / "two"
    # Address space: an interpreter with NumPy has most of a gigabyte of it.
    memory = ("--set", "environment.worker_memory_mb=2500")
    disturbed = train(path, run, "--steps", 300, *memory, RIT_TEST_FAULTS=faults, RIT_TEST_RUN=run)
    assert any(faults.iterdir())
    assert disturbed["weights_digest"] == undisturbed["weights_digest"]
    wait_until(lambda: not of_run(run))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("raises", "RuntimeError: the bridge is out"),
        ("hangs", "timed out: it did not answer within environment.timeout_ms = 500"),
        ("dies", "died: its process ended by itself (signal: 11"),
        ("nan", "bad answer: feature 0 of entity 0 is NaN; features are finite numbers"),
        ("reward", "bad answer: a reward of inf; rewards are finite numbers"),
        ("shape", "ValueError: entities has the shape (2, 3), not (3, 3)"),
        ("mask", "bad answer: agent 0 has no available action"),
        ("blind", "bad answer: agent 0 sees others and not itself"),
        ("nothing", "AttributeError"),
        ("hoards", "Unable to allocate 3.00 GiB"),
        ("imaginary", "TypeError: entities has the dtype complex64; features are real numbers"),
        ("words", "TypeError: entities has the dtype <U32; features are real numbers"),
    ],
)
def test_a_broken_promise_is_said_in_words(tmp_path, fault, words):
    path = experiment(tmp_path, training=["2"], timeout_ms=500)
    memory = ("--set", "environment.worker_memory_mb=2500")
    done = rit("env", "check", path, "--tasks", f"{fault}-2", *memory, check=False)
    assert done.returncode == 1 and f"task {fault}-2, episode 0, after 2 steps: " in done.stderr, done.stderr
    assert words in done.stderr
    # Where the environment's own code raised it, and only there.
    assert ("| RuntimeError: the bridge is out" in done.stderr) == (fault == "raises")


def test_one_that_hangs_is_the_one_that_is_named(tmp_path):
    """Its neighbours in the worker have answered; and it hangs before anything was waited for."""
    path = experiment(tmp_path, training=["2"], timeout_ms=1500)
    begun = time.monotonic()
    done = rit("env", "check", path, "--tasks", "stuck-2", check=False)
    assert "task stuck-2, episode 0, after 0 steps: timed out: it did not answer within" in done.stderr, done.stderr
    assert time.monotonic() - begun < 60, "a worker that is up is not waited for as if it came up"


def test_a_slow_environment_delays_no_other(tmp_path):
    """Three steps of 0.4 s each are in time, where each may take 0.9 s."""
    path = experiment(tmp_path, training=["slow-2"], timeout_ms=900)
    settings = ("--set", "algorithm.n_rollout_threads=3", "--set", "evaluation.episodes=1")
    assert train(path, tmp_path / "run", "--steps", 36, *settings)["ended"] == "finished"
    assert "is lost" not in (tmp_path / "run/logs/actor-0.log").read_text()


def test_what_keeps_its_promises_is_told_so(tmp_path):
    path = experiment(tmp_path)
    done = rit("env", "check", path, "--episodes", 3)
    assert "2: 2 agents, 3 entities, 3 features, 3 actions, at most 6 steps" in done.stdout
    assert done.stdout.count("the same seed gives the same episode") == 3
    chance = rit("env", "check", "--python", "worlds:make", "--tasks", "chance-2", "--json")
    assert json.loads(chance.stdout)["tasks"][0]["is_reproducible"] is False
    prints = rit("env", "check", "--python", "worlds:make", "--tasks", "prints-2,forever-2", check=False)
    assert prints.returncode == 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        ("worlds:broken_make", "KeyError: 'no task 2'"),
        ("worlds:not_an_environment", "returned int, neither a rit.env.EntityEnv nor a ParallelEnv"),
        ("worlds:nowhere", "has no attribute 'nowhere'"),
        ("nowhere:make", "No module named 'nowhere'"),
        ("nowhere", 'write "module:function"'),
    ],
)
def test_what_cannot_be_made_is_said_before_anything_is_there(tmp_path, make, words):
    run = tmp_path / "run"
    done = rit(
        *("train", experiment(tmp_path), "--run-dir", run, "--set", f"environment.python={make}"), check=False
    )
    assert done.returncode == 2 and not run.exists()
    assert words in done.stderr, done.stderr


def test_an_interpreter_that_will_not_do_is_named(tmp_path):
    for interpreter, words in (
        ("/nowhere/python", "/nowhere/python cannot be started: No such file"),
        ("/bin/false", "/bin/false -m rit.worker ended (exit status: 1); is the package rit-marl installed there?"),
    ):
        setting = f"environment.interpreter={interpreter}"
        done = rit("train", experiment(tmp_path), "--run-dir", tmp_path / "run", "--set", setting, check=False)
        assert done.returncode == 2 and words in done.stderr, done.stderr


def test_a_run_whose_environments_always_fail_ends_with_the_reason(tmp_path):
    path = experiment(tmp_path, training=["raises-2"])
    done = rit("train", path, "--run-dir", tmp_path / "run", "--steps", 100, "--seed", 3, check=False)
    assert done.returncode == 1
    assert "RuntimeError: the bridge is out" in done.stderr, done.stderr


def test_an_actor_whose_environments_always_fail_ends_the_run_once_the_limit_is_reached(tmp_path):
    """The learner's evaluations go well; what the actor rolls does not."""
    path, run = experiment(tmp_path, training=["training-2"]), tmp_path / "run"
    limit = ("--set", "environment.lost_rounds_max=2", "--set", "web.listen=off")
    done = rit("train", path, "--run-dir", run, "--actors", 1, "--steps", 100, "--seed", 3, *limit, check=False)
    assert done.returncode == 1
    assert "2 times in a row every episode was lost, the last: " in done.stderr, done.stderr
    assert "RuntimeError: the bridge is out (" in done.stderr and "worlds.py" in done.stderr
    shown = [line for line in done.stderr.splitlines() if line.startswith("| ")]
    assert shown[0] == "| Traceback (most recent call last):" and shown[-1] == "| RuntimeError: the bridge is out", shown
    assert done.stderr.count("Traceback") == 1
    assert "is restarted" not in done.stderr
    log = (run / "logs/actor-0.log").read_text()
    assert log.count("\nTraceback (most recent call last)") == 1, "while it went on"
    assert log.count("| Traceback (most recent call last)") == 1, "at its end"
    assert json.loads((run / "summary.json").read_text())["ended"] == "failed"


def test_no_worker_outlives_a_run_whatever_dies(tmp_path):
    run = tmp_path / "run"
    path = experiment(tmp_path, training=["2", "leaves-3"])
    command = [RIT, "train", path, "--run-dir", run, "--actors", 2, "--steps", "10M"]
    environment = {**os.environ, "RIT_TEST_RUN": str(run)}
    training = subprocess.Popen(
        list(map(str, command)), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: len(workers(run)) >= 2)
        actors = [pid for pid in children(training.pid) if b"actor" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        before = set(workers(run))
        for pid in actors:
            os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not before & set(workers(run)))
        wait_until(lambda: len(workers(run)) >= 2)
        for pid in [training.pid, *children(training.pid)]:
            os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not of_run(run))
    finally:
        training.kill()
        training.wait()


def children(pid):
    """The processes that a process has started."""
    lists = [task.joinpath("children").read_text() for task in Path(f"/proc/{pid}/task").iterdir()]
    return [int(child) for children_of_task in lists for child in children_of_task.split()]


def wait_until(condition):
    """Waits for something that must come."""
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < 60
        time.sleep(0.02)
