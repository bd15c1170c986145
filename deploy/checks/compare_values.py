#!/usr/bin/env python3
"""Holds Q_total of RIT to the discounted return that follows it, in episodes that are cut off at the limit and in others.

    pip install numpy
    rit export --run DIR --episodes 32 --tasks 3s,3s3z --out episodes.safetensors
    python3 deploy/checks/compare_values.py episodes.safetensors DIR/checkpoints/latest/weights.safetensors

The policy is that of deploy/docs/weights.md; Q_total is put together here, as the paper's appendix G has it. Greedy episodes of the
same weights: every action is compared, and exit code 1 says that one differs.
"""

import sys
from pathlib import Path

import numpy as np

import check_combat

page = (Path(__file__).parent.parent / "docs/weights.md").read_text()
exec(page.split("```python\n")[1].split("```")[0])
GAMMA = 0.99


class ValuedPolicy(NumpyPolicy):
    def q_total(self, entities, actions):
        """Of the joint action, in the state in which it was decided."""
        n, x = len(actions), relu(self.linear("mixer.embed", entities))
        seen = np.ones((n, len(x)))
        encoded = self.linear("mixer.out", self.attention("mixer.attention", x[:n], x, seen))
        c = np.hstack([encoded, self.task_representations])
        made = lambda name: self.linear(f"mixer.{name}", relu(self.linear(f"mixer.{name}_hidden", c)))
        w1, w2, b1 = np.abs(made("w1")), np.abs(made("w2").mean(0)), self.linear("mixer.b1", c).mean(0)
        mixed = self.utilities[np.arange(n), actions] @ w1 + b1
        return (np.where(mixed > 0, mixed, np.expm1(np.minimum(mixed, 0))) @ w2 + made("b2").mean(0))[0]


def play(policy, data, state, step, steps, order):
    """Q_total of each step of an episode that is played again, and how many actions differ."""
    n, rows = len(order), np.r_[order, np.arange(len(order), data["features"].shape[1])]
    policy.reset(n)
    values, differ, reward = [], 0, 0.0
    for at in range(steps):
        features, last = data["features"][state + at][rows], policy.last_actions
        observable, available = data["observable"][state + at][order][:, rows], data["available"][state + at][order]
        actions = policy.act(features, observable, available, reward)
        differ += (actions != data["actions"][step + at][order]).sum()
        entities = np.hstack([features, np.zeros((len(features), available.shape[1]))])
        if last is not None:
            entities[np.arange(n), features.shape[1] + last] = 1
        values.append(policy.q_total(entities, actions))
        reward = float(data["rewards"][step + at])
    return np.array(values), differ


def returns(rewards):
    """Discounted, from each step on."""
    out, after = np.zeros(len(rewards)), 0.0
    for at in reversed(range(len(rewards))):
        out[at] = after = rewards[at] + GAMMA * after
    return out


def main(episodes, weights):
    _, tasks = check_combat.read(episodes)
    policy, differ = ValuedPolicy(weights), 0
    for task, data in tasks.items():
        ends = {"cut off": [], "over": []}
        state = step = 0
        for steps, over, order in zip(data["steps"], data["terminated"], data["decision_order"]):
            values, others = play(policy, data, state, step, steps, order)
            differ += others
            ends["over" if over else "cut off"].append((values, returns(data["rewards"][step : step + steps])))
            state, step = state + steps + 1, step + steps
        print(task)
        for end, played in ends.items():
            for part, cut in [("first", slice(0, 10)), ("last", slice(-10, None))] if played else []:
                value, after = (np.mean([one[which][cut].mean() for one in played]) for which in (0, 1))
                print(f"  {len(played)} {end}, {part} ten steps: Q_total {value:.2f}, return {after:.2f}")
    print(f"{differ} actions differ")
    return 1 if differ else 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:3]))
