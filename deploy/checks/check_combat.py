#!/usr/bin/env python3
"""Holds masks, sight and rewards of combat episodes to the rules, by code of its own, and says how the episodes end.

    pip install numpy
    rit export --run DIR --episodes 32 --tasks 3s,3s3z --out episodes.safetensors
    python3 deploy/checks/check_combat.py episodes.safetensors

For units with their usual numbers (environment.stats = "liberty"). Positions are worked out from the features. Distances within 0.0001 of a rule's limit are left out, since a feature has no more
digits. Exit code 0: everything agrees; 1: something does not.
"""

import json
import struct
import sys
from collections import Counter

import numpy as np

TYPES = {"F32": np.float32, "U8": np.uint8, "BOOL": np.bool_, "I64": np.int64}
# Health and shield.
LIFE = {
    "colossus": (200, 150),
    "zealot": (100, 50),
    "stalker": (80, 80),
    "marine": (45, 0),
    "marauder": (125, 0),
    "medivac": (150, 0),
}
# 10 for each of eight enemies, 200 for the win, and all life of the set's largest team.
REWARD_MAX = {"3-8m": 640, "3-8sz": 1550, "3-8MMM": 930, "3-8csz": 1930}
ARENA, SIGHT, REACH, SLOP = 32, 9, 6, 1e-4
MOVES = [(0, 1), (0, -1), (1, 0), (-1, 0)]


def read(path):
    """What the file says of itself, and its arrays by task and name."""
    with open(path, "rb") as file:
        header = json.loads(file.read(*struct.unpack("<Q", file.read(8))))
        numbers = file.read()
    about, tasks = json.loads(header.pop("__metadata__")["rit"]), {}
    for key, entry in header.items():
        task, name = key.rsplit(".", 1)
        values = np.frombuffer(numbers[slice(*entry["data_offsets"])], TYPES[entry["dtype"]])
        tasks.setdefault(task, {})[name] = values.reshape(entry["shape"])
    return about, tasks


class Battle:
    """The states of one task's episodes: units in rows, allies first."""

    def __init__(self, about, data):
        column = {name: at for at, name in enumerate(about["feature_names"])}
        features = data["features"].astype(float)
        self.n, self.names = data["actions"].shape[1], [name[5:] for name in column if name.startswith("type.")]
        kinds = [column[f"type.{name}"] for name in self.names]
        self.names = self.names or ["marine"]
        self.kind = features[:, :, kinds].argmax(2) if kinds else np.zeros(features.shape[:2], int)
        life = np.array([LIFE[name] for name in self.names], float)[self.kind]
        shield = features[:, :, column["shield"]] if "shield" in column else 0
        self.life = features[:, :, column["health"]] * life[:, :, 0] + shield * life[:, :, 1]
        self.alive = features[:, :, column["health"]] > 0
        self.tag = features[:, :, column["tag.0"] :][:, :, :16].argmax(2)
        self.place = features[:, :, [column["x"], column["y"]]] * ARENA + ARENA / 2

    def is_medivac(self, unit):
        return self.names[unit] == "medivac"

    def may(self, state, agent, n_actions):
        """What the agent may do, whom it sees, and whether a distance is too close to a limit to tell."""
        may, sees = np.zeros(n_actions, bool), np.zeros(self.alive.shape[1], bool)
        sees[agent] = True
        if not self.alive[state, agent]:
            may[0] = True
            return may, sees, False
        x, y = self.place[state, agent]
        may[1] = True
        for move, (dx, dy) in enumerate(MOVES):
            may[2 + move] = all(0 <= int(at) < ARENA for at in (x + dx, y + dy))
        away = np.hypot(*(self.place[state] - (x, y)).T)
        heals = self.is_medivac(self.kind[state, agent])
        for unit in range(len(away)):
            is_target = unit < self.n and not self.is_medivac(self.kind[state, unit]) if heals else unit >= self.n
            if is_target and self.alive[state, unit] and away[unit] <= REACH:
                may[6 + self.tag[state, unit]] = True
        sees |= self.alive[state] & (away <= SIGHT)
        return may, sees, bool((np.abs(away[:, None] - (REACH, SIGHT)) < SLOP).any())

    def damage(self, state):
        """What the step after this state takes off the enemies' life, and 10 for each that dies."""
        before, after = self.life[state, self.n :], self.life[state + 1, self.n :]
        lived = self.alive[state, self.n :]
        died = lived & ~self.alive[state + 1, self.n :]
        return np.where(lived, before - after + 10 * died, 0).sum()

    def left(self, state, side):
        units = Counter(self.names[kind][0] for kind in self.kind[state, side][self.alive[state, side]])
        return "".join(f"{count}{name}" for name, count in sorted(units.items()))


def check(about, task, data):
    """Prints what the task's episodes are like; returns how many of their values are against the rules."""
    battle, scale = Battle(about, data), 20 / REWARD_MAX[about["task_set"]]
    allies, enemies = slice(0, battle.n), slice(battle.n, None)
    compared, wrong, cut = 0, Counter(), Counter()
    damage = recovery = 0.0
    state = step = 0
    for steps, won, over in zip(data["steps"], data["won"], data["terminated"]):
        for at in range(state, state + steps + 1):
            for agent in range(battle.n):
                may, sees, is_close = battle.may(at, agent, data["available"].shape[2])
                if not is_close:
                    compared += 1
                    wrong["masks"] += (data["available"][at, agent] != may).any()
                    wrong["sight"] += (data["observable"][at, agent] != sees).any()
        for at in range(steps):
            taken = battle.damage(state + at)
            reward = (abs(taken) + 200 * (won and at == steps - 1)) * scale
            wrong["rewards"] += abs(reward - data["rewards"][step + at]) > 5e-4
            damage, recovery = damage + max(taken, 0), recovery + max(-taken, 0)
        if not over:
            cut[f"{battle.left(state + steps, allies)} v {battle.left(state + steps, enemies)}"] += 1
        state, step = state + steps + 1, step + steps
    n, against = len(data["steps"]), ", ".join(f"{count} {what}" for what, count in wrong.items())
    print(
        f"{task}: {compared} masks, {len(data['rewards'])} rewards; wrong: {against}; won {data['won'].mean():.2f}, "
        f"cut off {cut.total() / n:.2f}, return {data['rewards'].sum() / n:.2f}: damage {damage * scale / n:.2f}, recovery "
        f"{recovery * scale / n:.2f}; left when cut off: {', '.join(f'{left} ({k})' for left, k in cut.most_common(3))}"
    )
    return wrong.total()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    about, tasks = read(sys.argv[1])
    wrong = sum([check(about, task, data) for task, data in tasks.items()])
    sys.exit(1 if wrong else 0)
