"""What a worker costs beside a bare Python loop: CPU time a step of mpe2's simple_spread, N = 3, eight environments in one worker.

``python benchmarks/bridge.py`` with the package and mpe2 installed. The bare loop resets and steps the same environments in
this process; the worker does so for frames, as ``rit`` sends them: all environments are told before the first is waited for.
"""

import json
import os
import socket
import struct
import subprocess
import sys
import time

from mpe2 import simple_spread_v3

from rit.worker import HEADER, HELLO, OPEN, PROTOCOL_VERSION, RESET, STEP

ENVIRONMENTS, STEPS, ROUNDS = 8, 8000, 3
#: Where a state's body says how the episode ended.
END = 4


def make(task):
    """For the worker, which imports this file."""
    return simple_spread_v3.parallel_env(N=int(task), max_cycles=25)


def bare():
    """CPU microseconds a step in this process."""
    envs = [make("3") for _ in range(ENVIRONMENTS)]
    steps, begun = 0, time.process_time()
    while steps < STEPS:
        for seed, env in enumerate(envs):
            env.reset(seed=steps + seed)
        while envs[0].agents:
            for env in envs:
                env.step({agent: steps % 5 for agent in env.agents})
            steps += ENVIRONMENTS
    return 1e6 * (time.process_time() - begun) / steps


def bridged():
    """CPU microseconds a step in a worker."""
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-m", "rit.worker", "bridge:make"]
    worker = subprocess.Popen(command, stdin=theirs, stdout=theirs, process_group=0, cwd=os.path.dirname(__file__) or ".")
    theirs.close()
    stream = ours.makefile("rwb")

    def ask(kind, bodies):
        for environment, body in bodies:
            stream.write(HEADER.pack(len(body), kind, environment) + body)
        stream.flush()
        return [stream.read(HEADER.unpack(stream.read(HEADER.size))[0]) for _ in bodies]

    everyone = range(ENVIRONMENTS)
    ask(HELLO, [(65535, json.dumps({"protocol": PROTOCOL_VERSION}).encode())])
    opened = json.dumps({"task": "3", "n_features": 0, "n_actions": 0, "describe": False}).encode()
    ask(OPEN, [(environment, opened) for environment in everyone])
    steps, begun = 0, cpu_seconds(worker.pid)
    while steps < STEPS:
        states = ask(RESET, [(environment, struct.pack("<Q", steps + environment)) for environment in everyone])
        while states[0][END] == 0:
            states = ask(STEP, [(environment, bytes([steps % 5] * 3)) for environment in everyone])
            steps += ENVIRONMENTS
    spent = cpu_seconds(worker.pid) - begun
    stream.close()
    ours.close()
    worker.wait()
    return 1e6 * spent / steps


def cpu_seconds(pid):
    """User and system time that a process has taken."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    for _ in range(ROUNDS):
        alone, worker = bare(), bridged()
        print(f"bare {alone:.0f} us a step, in a worker {worker:.0f} us: {100 * (worker / alone - 1):+.0f} %", flush=True)
