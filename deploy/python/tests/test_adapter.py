"""PettingZoo's parallel environments as worlds of entities."""

import numpy as np
import pytest

from rit.env import ParallelAdapter


class Discrete:
    def __init__(self, n, start=0):
        self.n, self.start = n, start


class Box:
    def __init__(self, *shape):
        self.shape = shape


class Dict:
    def __init__(self, **spaces):
        self.spaces = spaces


class Duel:
    """A knight and two archers, of different spaces. The second archer comes after the first step, the knight dies in it."""

    possible_agents = ["knight", "archer_0", "archer_1"]
    max_cycles = 3

    def observation_space(self, agent):
        return Dict(observation=Box(2, 2), action_mask=Box(3)) if agent == "knight" else Box(3)

    def action_space(self, agent):
        return Discrete(3) if agent == "knight" else Discrete(2, start=5)

    def reset(self, seed=None):
        self.agents, self.told, self.steps = ["knight", "archer_0"], [], 0
        observations = {
            "knight": {"observation": np.full((2, 2), seed), "action_mask": np.array([0, 1, 1])},
            "archer_0": np.arange(3),
        }
        return observations, {"knight": {}, "archer_0": {"action_mask": [True, False]}}

    def step(self, actions):
        self.told.append(actions)
        self.steps += 1
        observations = {agent: np.arange(3) for agent in ("archer_0", "archer_1")}
        cut = self.steps == 3
        terminations = {"archer_0": False, "archer_1": False}
        if self.steps == 1:
            terminations["knight"] = True
        self.agents = [] if cut else ["archer_0", "archer_1"]
        rewards = {agent: 2.0 for agent in terminations}
        return observations, rewards, terminations, {agent: cut for agent in terminations}, {}

    def close(self):
        pass


def test_agents_of_different_spaces_that_come_and_die():
    env = Duel()
    adapter = ParallelAdapter(env)
    assert (adapter.n_agents, adapter.n_entities, adapter.n_actions, adapter.steps_max) == (3, 3, 3, 3)
    names = ["observation.0", "observation.1", "observation.2", "observation.3", "alive", "type.0", "type.1"]
    assert adapter.feature_names == names
    state = adapter.reset(7)
    # Types in the order of their sizes: archers, knights.
    np.testing.assert_array_equal(
        state.entities, [[7, 7, 7, 7, 1, 0, 1], [0, 1, 2, 0, 1, 1, 0], [0, 0, 0, 0, 0, 1, 0]]
    )
    np.testing.assert_array_equal(state.available, [[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(state.observable, [[1, 1, 0], [1, 1, 0], [0, 0, 0]])

    step = adapter.step(np.array([2, 0, 0]))
    assert env.told == [{"knight": 2, "archer_0": 5}]
    assert (step.reward, step.terminated, step.truncated) == (6.0, False, False)
    np.testing.assert_array_equal(step.state.available, [[1, 0, 0], [1, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(step.state.observable, [[0, 0, 0], [0, 1, 1], [0, 1, 1]])
    adapter.step(np.array([0, 1, 0]))
    assert env.told[1] == {"archer_0": 6, "archer_1": 5}
    step = adapter.step(np.array([0, 1, 0]))
    # Cut off, so what they see last still counts.
    assert (step.terminated, step.truncated) == (False, True)
    np.testing.assert_array_equal(step.state.entities[:, 4], [0, 1, 1])


def test_what_is_configured():
    mean = ParallelAdapter(Duel(), team_reward="mean", sees="self", steps_max=9, won=lambda env, infos: env.steps > 1)
    assert (mean.steps_max, mean.has_wins) == (9, True)
    np.testing.assert_array_equal(mean.reset(1).observable, np.diag([1, 1, 0]))
    assert mean.step(np.zeros(3)).reward == 2.0
    assert mean.step(np.zeros(3)).won
    landmark = ParallelAdapter(
        Duel(),
        entities=lambda env, observations: np.arange(8).reshape(4, 2),
        sees=lambda env: np.ones((3, 4)),
        feature_names=["x", "y"],
    )
    state = landmark.reset(1)
    assert landmark.n_entities == 4 and state.entities.tolist() == np.arange(8).reshape(4, 2).tolist()
    np.testing.assert_array_equal(state.observable, [[1, 1, 0, 1], [1, 1, 0, 1], [0, 0, 0, 0]])


def test_an_agent_that_waits_for_its_turn_has_nothing_to_choose():
    env = Duel()
    adapter = ParallelAdapter(env, turns=True)
    env.reset = lambda seed: ({"knight": {"observation": np.zeros(4), "action_mask": np.zeros(3)}}, {})
    env.agents = ["knight"]
    np.testing.assert_array_equal(adapter.reset(0).available[0], [1, 0, 0])


def test_what_cannot_be_adapted_is_said():
    with pytest.raises(ValueError, match='team_reward = .max.; write "sum" or "mean"'):
        ParallelAdapter(Duel(), team_reward="max")
    env = Duel()
    env.action_space = lambda agent: Box(2)
    with pytest.raises(TypeError, match="actions are a Discrete space"):
        ParallelAdapter(env)
    env = Duel()
    env.max_cycles = None
    with pytest.raises(ValueError, match="the environment has no max_cycles; say how long an episode is"):
        ParallelAdapter(env)
    env = Duel()
    adapter = ParallelAdapter(env)
    env.reset = lambda seed: ({"knight": {"observation": np.zeros(4), "action_mask": [1, 1]}}, {})
    env.agents = ["knight"]
    with pytest.raises(ValueError, match=r"the action mask of knight has the shape \(2,\), not \(3,\)"):
        adapter.reset(0)
