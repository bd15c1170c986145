"""Environments that tests train on, and some that break their promises. Imported by workers from the tests' folder."""

import os
import subprocess
import time
from pathlib import Path

import numpy as np

from rit.env import EntityEnv, State, Step


#: The seed of the episodes by which a worker finds out whether an environment is reproducible, before a run begins.
PROBED = 7


class Gather(EntityEnv):
    """Agents on a line step left, stay or step right; the team is paid for being at the beacon."""

    n_features, n_actions, steps_max = 3, 3, 6
    feature_names = ["place", "is_agent", "is_beacon"]
    action_names = ["left", "stay", "right"]

    def __init__(self, n_agents):
        self.n_agents, self.n_entities = n_agents, n_agents + 1

    def reset(self, seed):
        self.seed, self.steps = seed, 0
        self.places = np.random.default_rng(seed).integers(-3, 4, self.n_entities)
        return self._state()

    def step(self, actions):
        self.places[:-1] = np.clip(self.places[:-1] + actions - 1, -3, 3)
        self.steps += 1
        reward = -float(np.abs(self.places[:-1] - self.places[-1]).sum())
        return Step(self._state(), reward, terminated=self.steps == self.steps_max)

    def _state(self):
        features = np.zeros((self.n_entities, 3), np.float32)
        features[:, 0] = self.places / 3
        features[:-1, 1] = 1
        features[-1, 2] = 1
        available = np.ones((self.n_agents, 3), np.uint8)
        available[self.places[:-1] == -3, 0] = 0
        return State(features, available=available)


class Stuck(Gather):
    """Hangs in the reset of a run."""

    def reset(self, seed):
        if seed != PROBED:
            time.sleep(1000)
        return super().reset(seed)


class Slow(Gather):
    """Takes its time."""

    def step(self, actions):
        if self.seed != PROBED:
            time.sleep(0.4)
        return super().step(actions)


class Recorded(Gather):
    """Writes down what it showed and what it was told, an episode a file."""

    def reset(self, seed):
        self.log = {"entities": [], "available": [], "actions": [], "rewards": []}
        return super().reset(seed)

    def step(self, actions):
        state = self._state()
        step = super().step(actions)
        for name, value in (
            ("entities", state.entities),
            ("available", state.available),
            ("actions", actions),
            ("rewards", step.reward),
        ):
            self.log[name].append(value)
        if step.terminated:
            np.savez(Path(os.environ["RIT_TEST_RECORDS"]) / f"{self.n_agents}-{self.seed}.npz", **self.log)
        return step


class Faulty(Gather):
    """Misbehaves in the third step of an episode of a run: always, or, with a folder, once for every fourth seed."""

    def __init__(self, n_agents, fault):
        super().__init__(n_agents)
        self.fault, self.folder = fault, os.environ.get("RIT_TEST_FAULTS")

    def step(self, actions):
        step = super().step(actions)
        if self.steps == 3 and self._is_due():
            getattr(self, self.fault)(step)
        return step

    def _is_due(self):
        if self.folder is None:
            return self.seed != PROBED
        mark = Path(self.folder) / str(self.seed)
        if self.seed % 4 or mark.exists():
            return False
        mark.touch()
        return True

    def raises(self, step):
        raise RuntimeError("the bridge is out")

    def hangs(self, step):
        time.sleep(1000)

    def dies(self, step):
        os.kill(os.getpid(), 11)

    def nan(self, step):
        step.state.entities[0, 0] = np.nan

    def reward(self, step):
        step.reward = float("inf")

    def shape(self, step):
        step.state.entities = step.state.entities[:-1]

    def mask(self, step):
        step.state.available[:] = 0

    def blind(self, step):
        step.state.observable = 1 - np.eye(self.n_agents, self.n_entities)

    def nothing(self, step):
        step.state = None

    def prints(self, step):
        print("x" * 100_000, flush=True)
        os.write(1, b"straight to the descriptor")

    def hoards(self, step):
        self.hoard = np.ones(3 << 30, np.uint8)

    def training(self, step):
        if b"\0actor\0" in Path(f"/proc/{os.getppid()}/cmdline").read_bytes():
            raise RuntimeError("the bridge is out")

    def forks(self, step):
        if os.fork() == 0:
            time.sleep(1000)

    def daemonises(self, step):
        subprocess.Popen(["sleep", "1000"], start_new_session=True)

    def leaves(self, step):
        self.daemonises(step)

    def returns_twice(self, step):
        os.fork()

    def imaginary(self, step):
        step.state.entities = step.state.entities * 1j

    def words(self, step):
        step.state.entities = step.state.entities.astype(str)

    def forever(self, step):
        self.steps = 0

    def chance(self, step):
        step.reward += np.random.default_rng().random()


def make(task):
    """`2`, `3`, …: so many agents; `recorded-2`; `raises-2` and the like."""
    fault, _, count = task.rpartition("-")
    own = {"recorded": Recorded, "stuck": Stuck, "slow": Slow}
    if fault in own:
        return own[fault](int(count))
    return Faulty(int(count), fault) if fault else Gather(int(count))


def broken_make(task):
    raise KeyError(f"no task {task}")


def not_an_environment(task):
    return 7
