"""Environments of your own: what one must do, and PettingZoo's parallel environments as they are.

An experiment names a function that makes them::

    [environment]
    python = "my_package.my_module:make"
    training_tasks = ["two", "four"]
    testing_tasks = ["five"]

``make(task)`` is called with a task's name and returns an :class:`EntityEnv`, or a PettingZoo ``ParallelEnv``, which
:class:`ParallelAdapter` then makes one of.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["EntityEnv", "ParallelAdapter", "State", "Step"]


@dataclass(slots=True)
class State:
    """What there is at a step."""

    #: Features, ``(n_entities, n_features)``: agents first, in an order that never changes, then everything else.
    entities: np.ndarray
    #: 1 where the row's agent sees the column's entity, ``(n_agents, n_entities)``. An agent sees itself, or nothing at all.
    #: Everything without.
    observable: np.ndarray | None = None
    #: 1 where the row's agent may take the column's action, ``(n_agents, n_actions)``; at least one each. Everything without.
    available: np.ndarray | None = None


@dataclass(slots=True)
class Step:
    """What a joint action led to."""

    state: State
    #: The team's reward.
    reward: float
    #: The episode is over, and so is all that could have been earned.
    terminated: bool = False
    #: The episode is cut off here, though it could have gone on.
    truncated: bool = False
    #: Whether the team has won; counts at the end, where the environment knows winning.
    won: bool = False


class EntityEnv:
    """A team in a world of entities. One object rolls many episodes, one after another."""

    n_agents: int
    #: Agents included.
    n_entities: int
    n_features: int
    n_actions: int
    #: An episode that is as long is cut off.
    steps_max: int
    #: Whether :attr:`Step.won` means anything.
    has_wins: bool = False
    #: What features and actions are called; numbers without.
    feature_names: list[str] | None = None
    action_names: list[str] | None = None

    def reset(self, seed: int) -> State:
        """Begins an episode. All its chance must come from this seed: the same seed and the same actions, the same episode."""
        raise NotImplementedError

    def step(self, actions: np.ndarray) -> Step:
        """Takes one joint action, ``(n_agents,)``, each available."""
        raise NotImplementedError

    def close(self) -> None:
        """Frees what the environment holds; called once, when it is no longer used."""


class ParallelAdapter(EntityEnv):
    """A PettingZoo ``ParallelEnv`` as an :class:`EntityEnv`.

    Every possible agent is an entity; its features are its own observation, flattened, then whether it is alive, then, where
    agents have different spaces, the one-hot of its type. Shorter observations are filled up with zeros, actions that an
    agent has not are unavailable to it. An agent that has left, or not yet come, has zeros, sees nothing, and has action 0
    alone, which the environment is not told.

    Action masks are read from ``observation["action_mask"]`` and from ``infos[agent]["action_mask"]``. An episode that ends
    because agents were truncated and none of these was terminated counts as cut off.
    """

    def __init__(
        self,
        env: Any,
        *,
        team_reward: str = "sum",
        steps_max: int | None = None,
        sees: Callable[[Any], np.ndarray] | str = "all",
        entities: Callable[[Any, Mapping[Any, Any]], Any] | None = None,
        feature_names: list[str] | None = None,
        won: Callable[[Any, Mapping[Any, Any]], bool] | None = None,
        turns: bool = False,
    ) -> None:
        """
        team_reward: ``"sum"`` or ``"mean"`` over the agents that are paid at a step.
        steps_max: the longest episode; without it the environment's ``max_cycles``.
        sees: who sees whom: ``"all"``, ``"self"``, or a function of the environment that returns flags
            ``(n_agents, n_entities)``.
        entities: features in place of the agents' observations: a function of the environment and of the agents'
            observations that returns ``(n_entities, n_features)``, the possible agents first.
        feature_names: what its columns are called.
        won: whether the team has won, a function of the environment and of the infos.
        turns: an agent whose action mask is all zeros is not wrong but waits for its turn, with action 0 alone, as in
            PettingZoo's classic games.
        """
        self.env = env
        self._possible = list(env.possible_agents)
        if not self._possible:
            raise ValueError("the environment has no possible agents")
        if team_reward not in ("sum", "mean"):
            raise ValueError(f'team_reward = {team_reward!r}; write "sum" or "mean"')
        if isinstance(sees, str) and sees not in ("all", "self"):
            raise ValueError(f'sees = {sees!r}; write "all", "self" or a function of the environment')
        self._team_reward, self._sees, self._entities, self._won = team_reward, sees, entities, won
        self._turns = turns
        self._spaces = [self._observation_space(agent) for agent in self._possible]
        self._widths = [_width(space) for space in self._spaces]
        counts = [self._action_count(agent) for agent in self._possible]
        self._n_actions_of, self._first_action_of = [count for count, _ in counts], [first for _, first in counts]
        kinds = list(zip(self._widths, self._n_actions_of))
        types = sorted(set(kinds))
        self.n_agents = len(self._possible)
        self.n_actions = max(self._n_actions_of)
        self.steps_max = steps_max if steps_max is not None else self._max_cycles()
        self.has_wins = won is not None
        self._width = max(self._widths)
        if entities is None:
            self.n_entities = self.n_agents
            names = feature_names or [f"observation.{column}" for column in range(self._width)]
            names = [*names, "alive"]
            if len(types) > 1:
                names += [f"type.{index}" for index in range(len(types))]
        else:
            observations, _ = env.reset(seed=0)
            shape = np.shape(entities(env, observations))
            if len(shape) != 2 or shape[0] < self.n_agents:
                raise ValueError(f"entities has the shape {shape}, not (n_entities, n_features), agents first")
            self.n_entities = shape[0]
            names = feature_names or [f"feature.{column}" for column in range(shape[1])]
            if len(names) != shape[1]:
                raise ValueError(f"{len(names)} feature_names for {shape[1]} features")
        self.feature_names = names
        self.n_features = len(names)
        # What most steps need and never changes.
        self._own_actions = np.zeros((self.n_agents, self.n_actions), np.uint8)
        for row, count in enumerate(self._n_actions_of):
            self._own_actions[row, :count] = 1
        self._are_alike = min(self._n_actions_of) == self.n_actions and not any(self._first_action_of)
        self._arrays, self._shapes = [np.ndarray] * self.n_agents, [(width,) for width in self._widths]
        self._places = [(row, slice(width)) for row, width in enumerate(self._widths)]
        if entities is None:
            # Features that no observation has: of agents that are not there, and of those that are.
            self._absent = np.zeros((self.n_agents, self.n_features), np.float32)
            if len(types) > 1:
                for row, kind in enumerate(kinds):
                    self._absent[row, self._width + 1 + types.index(kind)] = 1
            self._present = self._absent.copy()
            self._present[:, self._width] = 1

    def reset(self, seed: int) -> State:
        observations, infos = self.env.reset(seed=seed)
        return self._state(observations, infos)

    def step(self, actions: np.ndarray) -> Step:
        return self._take(actions.tolist())

    def _take(self, actions: Sequence[int]) -> Step:
        """As :meth:`step`."""
        alive = self.env.agents
        if self._are_alike and len(alive) == self.n_agents:
            joint = dict(zip(self._possible, actions))
        else:
            joint = {
                agent: action + first
                for agent, action, first in zip(self._possible, actions, self._first_action_of)
                if agent in alive
            }
        observations, rewards, terminations, truncations, infos = self.env.step(joint)
        total = float(sum(rewards.values()))
        if self._team_reward == "mean" and rewards:
            total /= len(rewards)
        over = not self.env.agents
        cut: Collection[Any] = ()
        if any(truncations.values()):
            # They could have gone on, so what they see last still counts.
            cut = [agent for agent, is_cut in truncations.items() if is_cut and not terminations.get(agent, False)]
        won = self._won is not None and bool(self._won(self.env, infos))
        state = self._state(observations, infos, cut)
        return Step(state, total, terminated=over and not cut, truncated=over and bool(cut), won=won)

    def close(self) -> None:
        self.env.close()

    def _state(
        self, observations: Mapping[Any, Any], infos: Mapping[Any, Any], cut: Collection[Any] = ()
    ) -> State:
        agents = self.env.agents
        if type(agents) is list and agents == self._possible and all(map(observations.__contains__, agents)):
            # What most steps are: everyone is there.
            rows = [observations[agent] for agent in agents]
            if list(map(type, rows)) == self._arrays and not any(infos.values()):
                return self._state_of_all(observations, rows)
            alive = [True] * len(agents)
        else:
            alive = [agent in observations and (agent in agents or agent in cut) for agent in self._possible]
        if self._entities is None:
            entities = self._own_features(observations, alive)
        else:
            entities = self._entities(self.env, observations)
        return State(entities, self._observable(alive), self._available(observations, infos, alive))

    def _state_of_all(self, observations: Mapping[Any, Any], rows: list[np.ndarray]) -> State:
        """As :meth:`_state`, where all agents are there, see arrays, and none has an action mask."""
        if self._entities is not None:
            entities = self._entities(self.env, observations)
        elif [row.shape for row in rows] == self._shapes:
            entities = self._present.copy()
            for place, row in zip(self._places, rows):
                entities[place] = row
        else:
            entities = self._own_features(observations, [True] * self.n_agents)
        observable = None if self._sees == "all" else self._observable([True] * self.n_agents)
        return State(entities, observable, None if self._are_alike else self._own_actions)

    def _own_features(self, observations: Mapping[Any, Any], alive: list[bool]) -> np.ndarray:
        entities = (self._present if all(alive) else self._absent).copy()
        for row, agent in enumerate(self._possible):
            if alive[row]:
                observation, width = observations[agent], self._widths[row]
                if type(observation) is not np.ndarray or observation.shape != (width,):
                    observation = _flat(self._spaces[row], width, _observation(observation))
                entities[row, :width] = observation
                entities[row, self._width] = 1
        return entities

    def _available(
        self, observations: Mapping[Any, Any], infos: Mapping[Any, Any], alive: list[bool]
    ) -> np.ndarray | None:
        available = None
        for row, agent in enumerate(self._possible):
            if alive[row]:
                observation, info = observations[agent], infos.get(agent)
                if not info and type(observation) is np.ndarray:
                    continue
                mask = _mask(observation, info)
                if mask is None:
                    continue
            else:
                mask = _NOTHING
            if available is None:
                available = self._own_actions.copy()
            available[row] = 0
            if mask is _NOTHING:
                available[row, 0] = 1
                continue
            count = self._n_actions_of[row]
            mask = np.asarray(mask)
            if mask.shape != (count,):
                raise ValueError(f"the action mask of {agent} has the shape {mask.shape}, not {(count,)}")
            available[row, :count] = mask != 0
            if self._turns and not mask.any():
                available[row, 0] = 1
        if available is None and not self._are_alike:
            return self._own_actions
        return available

    def _observable(self, alive: list[bool]) -> np.ndarray | None:
        if self._sees == "all":
            if all(alive):
                return None
            seen = np.ones((self.n_agents, self.n_entities), np.uint8)
        elif self._sees == "self":
            seen = np.eye(self.n_agents, self.n_entities, dtype=np.uint8)
        else:
            seen = np.array(self._sees(self.env), dtype=np.uint8)
            if seen.shape != (self.n_agents, self.n_entities):
                raise ValueError(f"sees returned {seen.shape}, not {(self.n_agents, self.n_entities)}")
        there = np.array(alive)
        seen[:, : self.n_agents] &= there
        seen[~there] = 0
        return seen

    def _observation_space(self, agent: Any) -> Any:
        space = self.env.observation_space(agent)
        inner = getattr(space, "spaces", None)
        if isinstance(inner, Mapping) and "observation" in inner:
            return inner["observation"]
        return space

    def _action_count(self, agent: Any) -> tuple[int, int]:
        """How many actions there are, and the number of the first."""
        space = self.env.action_space(agent)
        if type(space).__name__ != "Discrete":
            raise TypeError(f"the actions of {agent} are {space}; actions are a Discrete space")
        return int(space.n), int(getattr(space, "start", 0))

    def _max_cycles(self) -> int:
        for env in (self.env, getattr(self.env, "unwrapped", None)):
            cycles = getattr(env, "max_cycles", None)
            if isinstance(cycles, (int, np.integer)) and cycles > 0:
                return int(cycles)
        raise ValueError("the environment has no max_cycles; say how long an episode is: ParallelAdapter(env, steps_max=…)")


#: The mask of an agent that is not there.
_NOTHING = object()


def _mask(*places: Any) -> Any:
    """The action mask in an observation or in an info, if there is one."""
    for place in places:
        if isinstance(place, dict):
            mask = place.get("action_mask")
            if mask is not None:
                return mask
    return None


def _observation(observation: Any) -> Any:
    """Without the action mask beside it."""
    if isinstance(observation, dict) and "observation" in observation:
        return observation["observation"]
    return observation


def _is_array(space: Any) -> bool:
    return getattr(space, "shape", None) is not None and type(space).__name__ != "Discrete"


def _width(space: Any) -> int:
    """Numbers in an observation."""
    if _is_array(space):
        return int(np.prod(space.shape))
    from gymnasium.spaces.utils import flatdim

    return int(flatdim(space))


def _flat(space: Any, width: int, observation: Any) -> np.ndarray:
    """An observation's numbers."""
    if isinstance(observation, np.ndarray) and observation.size == width:
        return observation.reshape(-1)
    if _is_array(space):
        vector = np.asarray(observation, np.float32).reshape(-1)
        if len(vector) != width:
            raise ValueError(f"an observation has {len(vector)} numbers, its space {width}")
        return vector
    from gymnasium.spaces.utils import flatten

    return np.asarray(flatten(space, observation), np.float32)
