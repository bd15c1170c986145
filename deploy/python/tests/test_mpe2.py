"""An environment of another project: simple_spread of mpe2, of two and four agents in training, two to five in testing."""

import json

import numpy as np
import pytest
from conftest import rit, train
from test_readme import snippets

simple_spread_v3 = pytest.importorskip("mpe2.simple_spread_v3")

EXPERIMENT = """
[environment]
python = "spread:make"
training_tasks = ["2", "4"]
testing_tasks = ["2", "3", "4", "5"]

[algorithm]
batch_size = 16

[network]
hidden_dim = 16

[evaluation]
every_env_steps = 1000000
episodes = 2
testing_episodes = 2
"""


@pytest.fixture
def spread(tmp_path, monkeypatch):
    """The page's adapter as a module, and an experiment on it."""
    *_, adapter = snippets("Your own environment")
    (tmp_path / "spread.py").write_text(adapter)
    (tmp_path / "spread.toml").write_text(EXPERIMENT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_it_keeps_its_promises(spread):
    done = rit("env", "check", "spread.toml", "--episodes", 2)
    assert "4: 4 agents, 8 entities, 6 features, 5 actions, at most 25 steps" in done.stdout
    assert "does NOT" not in done.stdout


def test_it_trains_and_is_measured_on_teams_never_seen(spread):
    run, summary = train(spread, "spread.toml", "--steps", 1500, "--seed", 2)
    assert summary["ended"] == "finished" and summary["updates"] > 0
    measured = json.loads(rit("evaluate", "--run", run, "--tasks", "testing", "--json").stdout)["tasks"]
    assert sorted(measured) == ["2", "3", "4", "5"]


def test_its_rewards_are_the_environments_own(spread):
    """A policy that stands still, rolled by the program and by hand."""
    namespace = {}
    exec((spread / "spread.py").read_text(), namespace)
    done = rit("env", "check", "spread.toml", "--episodes", 1, "--json")
    (task, *_) = json.loads(done.stdout)["tasks"]
    assert task["steps"] == 25 and task["mean_return"] < 0
    env = simple_spread_v3.parallel_env(N=2, max_cycles=25)
    adapter = namespace["make"]("2")
    env.reset(seed=5)
    adapter.reset(5)
    for _ in range(25):
        _, rewards, _, _, _ = env.step({agent: 1 for agent in env.agents})
        step = adapter.step(np.array([1, 1]))
        assert step.reward == sum(rewards.values())
    assert step.truncated and not step.terminated
