"""Environments of other projects: PettingZoo's own, one whose agents die, and one with action masks and turns."""

import json

import numpy as np
import pytest
from conftest import rit, train

pytest.importorskip("pettingzoo.butterfly.knights_archers_zombies_v11")
pytest.importorskip("pettingzoo.classic.connect_four_v3")

WORLDS = """
from pettingzoo.butterfly import knights_archers_zombies_v11
from pettingzoo.classic import connect_four_v3
from pettingzoo.utils.conversions import turn_based_aec_to_parallel
from rit.env import ParallelAdapter


def knights(task):
    # As many archers as knights. Who touches the upper or lower border dies.
    n = int(task)
    return knights_archers_zombies_v11.parallel_env(
        num_archers=n, num_knights=n, max_zombies=4, max_arrows=4, spawn_delay=4, line_death=True, max_cycles=40
    )


def four(task):
    return ParallelAdapter(turn_based_aec_to_parallel(connect_four_v3.env()), steps_max=42, turns=True)
"""

EXPERIMENT = """
[environment]
python = "worlds_of_others:{make}"
training_tasks = {tasks}

[algorithm]
batch_size = 8

[network]
hidden_dim = 16

[evaluation]
every_env_steps = 1000000
episodes = 2
"""


@pytest.fixture
def experiment(tmp_path, monkeypatch):
    """Writes an experiment on one of the worlds into a folder that workers import from."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "worlds_of_others.py").write_text(WORLDS)

    def write(make, *tasks):
        path = tmp_path / "experiment.toml"
        path.write_text(EXPERIMENT.format(make=make, tasks=json.dumps(tasks)))
        return path

    return write


def test_agents_that_die_are_trained(tmp_path, experiment):
    path = experiment("knights", "1", "2")
    done = rit("env", "check", path, "--episodes", 2)
    assert "2: 4 agents, 4 entities, " in done.stdout
    run, summary = train(tmp_path, path, "--steps", 600, "--seed", 2)
    assert summary["ended"] == "finished" and summary["updates"] > 0


def test_its_dead_stay_in_their_places(experiment):
    namespace = {}
    experiment("knights", "2")
    exec(WORLDS, namespace)
    adapter = namespace["ParallelAdapter"](namespace["knights"]("2"))
    adapter.reset(3)
    died = False
    for _ in range(40):
        # Archers walk back, off the lower border; knights stand still.
        step = adapter.step(np.array([1, 1, 5, 5]))
        if step.terminated or step.truncated:
            break
        gone = [agent not in adapter.env.agents for agent in adapter.env.possible_agents]
        died |= any(gone)
        alive = step.state.entities[:, adapter.feature_names.index("alive")]
        np.testing.assert_array_equal(alive, 1 - np.array(gone))
        if died:
            np.testing.assert_array_equal(step.state.available[gone], [[1, 0, 0, 0, 0, 0]] * sum(gone))
            assert not step.state.observable[gone].any() and not step.state.observable[:, gone].any()
    assert died


def test_what_is_masked_is_never_played(tmp_path, experiment):
    """The game prints a warning when a move was illegal."""
    path = experiment("four", "one")
    done = rit("env", "check", path, "--episodes", 3)
    assert "one: 2 agents, 2 entities, " in done.stdout and "the same seed gives the same episode" in done.stdout
    run, summary = train(tmp_path, path, "--steps", 400, "--seed", 2)
    assert summary["ended"] == "finished" and summary["updates"] > 0
    logs = "".join(log.read_text() for log in (run / "logs").iterdir())
    assert "llegal" not in done.stderr + logs, logs
