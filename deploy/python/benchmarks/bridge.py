"""What environments cost in a worker, beside a bare Python loop over the same: mpe2's simple_spread, N = 3.

``python benchmarks/bridge.py`` with the package and mpe2 installed; ``--environments 32`` for more of them in a worker,
``--seconds`` for longer. In turn, an episode of every environment each, so that all meet the same machine:

- ``bare``: a loop in this process that resets and steps the environments, one after another;
- ``adapter``: the same loop with the adapter and the encoding of a worker;
- ``halves``: a worker that answers the frames of this process as ``rit`` sends them: one half of the environments is told
  while the other half steps;
- ``rounds``: the same worker, but all environments are told, then all are waited for, so it sleeps once a step;
- ``two``: two workers in halves.

Of each: microseconds a step of CPU time (the worker's process, all its threads) and of the clock, and how much more than ``bare``
that is: of the sums of all turns, of the median turn against the bare turn beside it, and of the quietest tenth of the turns, which a
busy machine disturbs least.
"""

import argparse
import json
import os
import socket
import statistics
import struct
import subprocess
import sys
import time

from mpe2 import simple_spread_v3

from rit.env import ParallelAdapter
from rit.worker import HEADER, HELLO, OPEN, PROTOCOL_VERSION, RESET, STEP, Opened

N, STEPS = 3, 25
#: Where a state's body says how the episode ended.
END = 4


def make(task):
    """For the worker, which imports this file."""
    return simple_spread_v3.parallel_env(N=int(task), max_cycles=STEPS)


def actions(step):
    return [(step + agent) % 5 for agent in range(N)]


class Bare:
    """Environments in this process."""

    def __init__(self, count):
        self.envs = [make(N) for _ in range(count)]
        self.count = count

    def episode(self, seed):
        for at, env in enumerate(self.envs):
            env.reset(seed=seed + at)
        for step in range(STEPS):
            chosen = actions(step)
            for env in self.envs:
                env.step(dict(zip(env.agents, chosen)))

    def cpu_s(self):
        return time.process_time()


class Adapted(Bare):
    """With what a worker does to them."""

    def __init__(self, count):
        super().__init__(count)
        self.opened = [Opened(ParallelAdapter(env), 0, 0) for env in self.envs]

    def episode(self, seed):
        for at, opened in enumerate(self.opened):
            opened.reset(seed + at)
        for step in range(STEPS):
            chosen = bytes(actions(step))
            for opened in self.opened:
                body = opened.step(chosen)
        assert body[END] != 0


class Worker:
    """A process as ``rit`` starts it."""

    def __init__(self, count):
        self.socket, theirs = socket.socketpair()
        command = [sys.executable, "-m", "rit.worker", "bridge:make"]
        here = os.path.dirname(os.path.abspath(__file__))
        self.process = subprocess.Popen(command, stdin=theirs, stdout=theirs, process_group=0, cwd=here)
        theirs.close()
        self.answers = self.socket.makefile("rb")
        self.tell(HELLO, [65535], json.dumps({"protocol": PROTOCOL_VERSION}).encode())
        self.hear(1)
        opened = {"task": str(N), "n_features": 0, "n_actions": 0, "describe": False}
        self.tell(OPEN, range(count), json.dumps(opened).encode())
        self.hear(count)

    def tell(self, kind, environments, body):
        for environment in environments:
            self.socket.sendall(HEADER.pack(len(body), kind, environment) + body)

    def hear(self, count):
        for _ in range(count):
            body = self.answers.read(HEADER.unpack(self.answers.read(HEADER.size))[0])
        return body

    def cpu_s(self):
        """Of the whole process so far: Linux has a clock for each."""
        return time.clock_gettime(~self.process.pid << 3 | 2)

    def end(self):
        self.answers.close()
        self.socket.close()
        self.process.wait()


class Bridged:
    """Workers, in so many groups of environments that are told and heard in turn."""

    def __init__(self, workers, count, groups):
        self.workers, self.count = workers, count * len(workers)
        self.groups = [range(count)[group::groups] for group in range(groups)]

    def episode(self, seed):
        for worker in self.workers:
            worker.tell(RESET, range(self.count // len(self.workers)), struct.pack("<Q", seed))
        for worker in self.workers:
            worker.hear(self.count // len(self.workers))
        for step in range(STEPS + 1):
            for group in self.groups:
                if step > 0:
                    bodies = [worker.hear(len(group)) for worker in self.workers]
                if step < STEPS:
                    for worker in self.workers:
                        worker.tell(STEP, group, bytes(actions(step)))
        assert all(body[END] != 0 for body in bodies)

    def cpu_s(self):
        return sum(worker.cpu_s() for worker in self.workers)


def measured(one, seed):
    """Microseconds a step: of CPU time, of the clock."""
    cpu, begun = one.cpu_s(), time.perf_counter()
    one.episode(seed)
    cpu, wall = one.cpu_s() - cpu, time.perf_counter() - begun
    return [1e6 * seconds / (STEPS * one.count) for seconds in (cpu, wall)]


def quietest(turns):
    """The turn that a tenth of all are below."""
    return sorted(turns)[len(turns) // 10]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--environments", type=int, default=8, help="of a worker")
    parser.add_argument("--seconds", type=float, default=60)
    options = parser.parse_args()
    count = options.environments
    workers = [Worker(count) for _ in range(2)]
    sides = {
        "bare": Bare(count),
        "adapter": Adapted(count),
        "halves": Bridged(workers[:1], count, 2),
        "rounds": Bridged(workers[:1], count, 1),
        "two": Bridged(workers, count, 2),
    }
    turns = {name: [] for name in sides}
    begun, seed = time.perf_counter(), 0
    for name, side in sides.items():
        side.episode(seed)
    while time.perf_counter() - begun < options.seconds:
        seed += 100
        for name, side in sides.items():
            turns[name].append(measured(side, seed))
    print(f"{len(turns['bare'])} turns of {count} environments, {STEPS} steps; load {os.getloadavg()[0]:.1f}")
    print("us a step   CPU   sums  medians  quiet   clock   sums  medians  quiet")
    for name, measures in turns.items():
        line = f"{name:9}"
        for kind in (0, 1):
            own, bare = [turn[kind] for turn in measures], [turn[kind] for turn in turns["bare"]]
            of_sums = sum(own) / sum(bare) - 1
            of_medians = statistics.median(a / b for a, b in zip(own, bare)) - 1
            quiet = quietest(own) / quietest(bare) - 1
            line += f" {statistics.median(own):6.0f} {of_sums:+6.1%}  {of_medians:+6.1%} {quiet:+6.1%} "
        print(line)
    for worker in workers:
        worker.end()


if __name__ == "__main__":
    main()
