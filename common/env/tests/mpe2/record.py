"""Records episodes of mpe2's simple_spread for the tests: ``pip install mpe2==1.1.1``, then ``python record.py > simple_spread.json``.

Actions persist for a few steps, so that bodies gather speed, and agents start close to each other, so that they collide.
"""

import json

import numpy as np
from mpe2 import simple_spread_v3

STEPS = 25


def record(n, seed):
    """One episode: where bodies start, and what each joint action leads to."""
    env = simple_spread_v3.parallel_env(N=n, max_cycles=STEPS)
    env.reset(seed=seed)
    world, rng = env.unwrapped.world, np.random.default_rng(seed)
    for agent in world.agents:
        agent.state.p_pos = rng.uniform(-0.3, 0.3, 2)
    start = positions(world)
    actions = rng.integers(5, size=n)
    steps = []
    for _ in range(STEPS):
        actions = np.where(rng.random(n) < 0.4, rng.integers(5, size=n), actions)
        named = dict(zip(env.possible_agents, actions.tolist()))
        _, rewards, terminations, truncations, _ = env.step(named)
        steps.append(
            {
                "actions": actions.tolist(),
                "positions": positions(world)[:n],
                "velocities": [numbers(agent.state.p_vel) for agent in world.agents],
                "reward": round(float(sum(rewards.values())), 7),
                "terminated": any(terminations.values()),
                "truncated": any(truncations.values()),
            }
        )
    return {"n": n, "start": start, "steps": steps}


def positions(world):
    return [numbers(body.state.p_pos) for body in world.entities]


def numbers(vector):
    return [round(float(value), 7) for value in vector]


if __name__ == "__main__":
    episodes = [record(n, seed) for seed, n in enumerate([1, 2, 3, 3, 5])]
    print("[" + ",\n".join(json.dumps(episode, separators=(",", ":")) for episode in episodes) + "]")
