"""Trained policies, by the same code as ``rit evaluate``: the same bits."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from rit._rit import ActError, NativePolicy


class Policy:
    """A trained policy, acting greedily in one environment or in many at once.

    ::

        policy = rit.Policy.load("runs/cooperative-navigation-1")
        policy.reset(n_agents=3)
        actions = policy.act(entities, previous_reward=0.0)

    ``entities`` are the features of all entities, agents first, without last actions: those the policy remembers by itself.
    """

    def __init__(self, native: NativePolicy) -> None:
        self._native = native
        self._feature_dim, self._n_actions, self._representation_dim = native.sizes()
        self._description: dict[str, Any] = json.loads(native.description())
        #: Agents of each environment; an int where there is one alone.
        self._agents: int | list[int] | None = None

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """The weights of a run's newest checkpoint, of one of its checkpoints (``RUN@STEPS``), or of a weights file."""
        return cls(NativePolicy.load(os.fspath(path)))

    @property
    def description(self) -> dict[str, Any]:
        """What the weights file says of itself: method, sizes, names."""
        return self._description

    @property
    def method(self) -> str:
        """The algorithm."""
        return self._description["method"]

    @property
    def feature_names(self) -> list[str]:
        """Features of an entity, by column."""
        return self._description["feature_names"]

    @property
    def action_names(self) -> list[str]:
        """Actions, by number."""
        return self._description["action_names"]

    @property
    def n_actions(self) -> int:
        """The size of the action space."""
        return self._n_actions

    def reset(
        self,
        n_agents: int | Sequence[int],
        order: Sequence[int] | Sequence[Sequence[int]] | None = None,
    ) -> None:
        """Begins an episode; with a list of numbers of agents, one in each of as many environments.

        ``order`` says who decides when: ``order[k]`` is the k-th agent to decide. Without it agents decide in their own order.
        """
        if isinstance(n_agents, (int, np.integer)):
            self._begin(0, int(n_agents), order)
            self._agents = int(n_agents)
            return
        counts = [int(count) for count in n_agents]
        orders = [None] * len(counts) if order is None else list(order)
        if len(orders) != len(counts):
            raise ActError(f"{len(orders)} decision orders for {len(counts)} environments")
        for environment, (count, of_it) in enumerate(zip(counts, orders)):
            self._begin(environment, count, of_it)
        self._agents = counts

    def reset_one(self, environment: int, n_agents: int, order: Sequence[int] | None = None) -> None:
        """Begins another episode in one of many environments, while the others go on."""
        if not isinstance(self._agents, list) or not 0 <= environment < len(self._agents):
            raise ActError(f"there is no environment {environment}; reset([...]) says how many there are")
        self._begin(environment, int(n_agents), order)
        self._agents[environment] = int(n_agents)

    def act(
        self,
        entities: Any,
        observable: Any = None,
        available: Any = None,
        previous_reward: Any = 0.0,
    ) -> Any:
        """The joint action, an action for each agent.

        entities: features, ``(n_entities, features)``, agents first.
        observable: 1 where the row's agent sees the column's entity, ``(n_agents, n_entities)``; everything without.
        available: 1 where the row's agent may take the column's action, ``(n_agents, n_actions)``; everything without.
        previous_reward: the team reward of the step before; 0 at an episode's first.

        For many environments each is a list of as many; an environment whose entities are ``None`` does not act, and its
        actions are ``None``.
        """
        if self._agents is None:
            raise ActError("no episode has begun; call reset(n_agents) first")
        if isinstance(self._agents, int):
            self._native.act([self._seen(0, self._agents, entities, observable, available, previous_reward)])
            return self._actions(0)
        count = len(self._agents)
        given = {
            "entities": entities,
            "observable": observable,
            "available": available,
            "previous_reward": previous_reward,
        }
        for name, values in given.items():
            if values is None or np.isscalar(values):
                given[name] = [values] * count
            elif len(values) != count:
                raise ActError(f"{name} is of {len(values)} environments, not {count}")
        acting = [environment for environment in range(count) if given["entities"][environment] is not None]
        seen = [
            self._seen(environment, self._agents[environment], *(values[environment] for values in given.values()))
            for environment in acting
        ]
        self._native.act(seen)
        return [self._actions(environment) if environment in acting else None for environment in range(count)]

    def utilities(self, environment: int = 0) -> np.ndarray:
        """What the last actions were chosen by, ``(n_agents, n_actions)``: each agent's utilities given the actions of those
        that decided before it, or logits of a method with a policy network."""
        return self._rows(self._native.utilities(environment), self._n_actions)

    def task_representations(self, environment: int = 0) -> np.ndarray | None:
        """What each agent took the task for in the last step, ``(n_agents, h_z)``; ``None`` where the method has none."""
        if self._representation_dim == 0:
            return None
        return self._rows(self._native.task_representations(environment), self._representation_dim)

    def _begin(self, environment: int, n_agents: int, order: Any) -> None:
        if n_agents < 0:
            raise ActError(f"episode {environment}: {n_agents} agents")
        if order is not None:
            order = [int(agent) for agent in order]
            if not all(0 <= agent < 256 for agent in order):
                raise ActError(f"episode {environment}: the decision order must have each of 0 to {n_agents - 1} once")
            order = bytes(order)
        self._native.begin(environment, n_agents, order)

    def _seen(
        self, environment: int, n: int, entities: Any, observable: Any, available: Any, previous_reward: Any
    ) -> tuple[int, int, int, bytes, bytes, bytes, float]:
        features = np.ascontiguousarray(entities, dtype=np.float32)
        if features.ndim != 2 or features.shape[1] != self._feature_dim:
            raise ActError(
                f"episode {environment}: entities are {features.shape}, not (n_entities, {self._feature_dim})"
            )
        m = len(features)
        observable = self._flags(environment, "observable", observable, (n, m))
        available = self._flags(environment, "available", available, (n, self._n_actions))
        return environment, n, m, features.tobytes(), observable, available, float(previous_reward)

    @staticmethod
    def _flags(environment: int, name: str, given: Any, shape: tuple[int, int]) -> bytes:
        if given is None:
            return np.ones(shape, np.uint8).tobytes()
        given = np.asarray(given)
        if given.shape != shape:
            raise ActError(f"episode {environment}: {name} is {given.shape}, not {shape}")
        if not np.isin(given, (0, 1)).all():
            raise ActError(f"episode {environment}: {name} must be 0 or 1 everywhere")
        return given.astype(np.uint8).tobytes()

    def _actions(self, environment: int) -> np.ndarray:
        return np.frombuffer(self._native.actions(environment), np.uint8).astype(np.int64)

    @staticmethod
    def _rows(numbers: bytes, width: int) -> np.ndarray:
        return np.frombuffer(numbers, np.float32).reshape(-1, width)
