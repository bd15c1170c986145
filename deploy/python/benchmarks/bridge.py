"""What a worker costs beside a bare Python loop over mpe2's simple_spread, N = 3, and whether workers work side by side.

``python benchmarks/bridge.py`` with the package and mpe2 installed; ``--environments 32`` for more of them in a worker. CPU
microseconds a step of

- ``bare``: a loop that resets and steps the environments in this process,
- ``pausing``: the same loop, asleep for half a millisecond after each round, as any process is that waits for another's actions,
- ``adapter``: the loop with the adapter and the encoding of a worker, in this process,
- ``worker``: a worker that answers the frames of this process, as ``rit`` sends them: all environments are told first.

Then steps a second, by the clock, of one worker and of two.
"""

import argparse
import json
import os
import socket
import struct
import subprocess
import sys
import time

from mpe2 import simple_spread_v3

from rit.env import ParallelAdapter
from rit.worker import HEADER, HELLO, OPEN, PROTOCOL_VERSION, RESET, STEP, Opened

STEPS, ROUNDS, PAUSE_S = 4000, 5, 0.0005
#: Where a state's body says how the episode ended.
END = 4


def make(task):
    """For the worker, which imports this file."""
    return simple_spread_v3.parallel_env(N=int(task), max_cycles=25)


def bare(envs, pause_s=0.0):
    """CPU microseconds a step."""
    steps, begun = 0, time.process_time()
    while steps < STEPS:
        for seed, env in enumerate(envs):
            env.reset(seed=steps + seed)
        while envs[0].agents:
            if pause_s:
                time.sleep(pause_s)
            for env in envs:
                env.step({agent: steps % 5 for agent in env.agents})
            steps += len(envs)
    return 1e6 * (time.process_time() - begun) / steps


def adapted(envs):
    """CPU microseconds a step."""
    opened = [Opened(ParallelAdapter(env), 0, 0) for env in envs]
    steps, begun = 0, time.process_time()
    while steps < STEPS:
        states = [one.reset(steps + seed) for seed, one in enumerate(opened)]
        while states[0][END] == 0:
            states = [one.step(bytes([steps % 5] * 3)) for one in opened]
            steps += len(envs)
    return 1e6 * (time.process_time() - begun) / steps


class Worker:
    """A process as ``rit`` starts it."""

    def __init__(self, environments):
        self.environments = range(environments)
        self.socket, theirs = socket.socketpair()
        command = [sys.executable, "-m", "rit.worker", "bridge:make"]
        here = os.path.dirname(__file__) or "."
        self.process = subprocess.Popen(command, stdin=theirs, stdout=theirs, process_group=0, cwd=here)
        theirs.close()
        self.stream = self.socket.makefile("rwb")
        self.ask(HELLO, [(65535, json.dumps({"protocol": PROTOCOL_VERSION}).encode())])
        opened = json.dumps({"task": "3", "n_features": 0, "n_actions": 0, "describe": False}).encode()
        self.ask(OPEN, [(environment, opened) for environment in self.environments])

    def tell(self, kind, bodies):
        for environment, body in bodies:
            self.stream.write(HEADER.pack(len(body), kind, environment) + body)
        self.stream.flush()

    def hear(self, count):
        return [self.stream.read(HEADER.unpack(self.stream.read(HEADER.size))[0]) for _ in range(count)]

    def ask(self, kind, bodies):
        self.tell(kind, bodies)
        return self.hear(len(bodies))

    def cpu_s(self):
        """User and system time that it has taken."""
        with open(f"/proc/{self.process.pid}/stat") as file:
            fields = file.read().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def end(self):
        self.stream.close()
        self.socket.close()
        self.process.wait()


def bridged(workers):
    """CPU microseconds a step, and steps a second by the clock, of so many steps of each worker."""
    steps, cpu_begun, begun = 0, sum(worker.cpu_s() for worker in workers), time.perf_counter()
    count = len(workers[0].environments)
    while steps < STEPS * len(workers):
        for worker in workers:
            worker.tell(RESET, [(at, struct.pack("<Q", steps + at)) for at in worker.environments])
        states = [worker.hear(count) for worker in workers]
        while states[0][0][END] == 0:
            for worker in workers:
                worker.tell(STEP, [(at, bytes([steps % 5] * 3)) for at in worker.environments])
            states = [worker.hear(count) for worker in workers]
            steps += count * len(workers)
    cpu_s = sum(worker.cpu_s() for worker in workers) - cpu_begun
    return 1e6 * cpu_s / steps, steps / (time.perf_counter() - begun)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--environments", type=int, default=8, help="of a worker")
    count = parser.parse_args().environments
    envs = [make("3") for _ in range(count)]
    workers = [Worker(count) for _ in range(2)]
    columns = ("bare", "pausing", "adapter", "worker")
    print(f"CPU us a step: {', '.join(columns)}; steps/s of 1 worker, of 2")
    for _ in range(ROUNDS):
        alone, rate = bridged(workers[:1])
        _, rate_of_two = bridged(workers)
        costs = (bare(envs), bare(envs, PAUSE_S), adapted(envs), alone)
        shown = [f"{cost:.0f} ({100 * (cost / costs[0] - 1):+.0f} %)" for cost in costs]
        print(f"{', '.join(shown)}; {rate:.0f}, {rate_of_two:.0f}", flush=True)
    for worker in workers:
        worker.end()


if __name__ == "__main__":
    main()
