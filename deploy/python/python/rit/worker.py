"""A process that holds environments: ``python -m rit.worker MODULE:MAKE``, started by ``rit``.

Frames come on standard input and go to what standard output was; ``deploy/docs/environments.md`` has the protocol. What
environments print goes to standard error.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import select
import signal
import struct
import sys
import threading
import traceback
from typing import Any

import numpy as np

from rit.env import EntityEnv, ParallelAdapter, State, Step

#: What this package speaks. It changes when a frame changes its meaning.
PROTOCOL_VERSION = 1

#: Bytes in the body, kind, environment.
HEADER = struct.Struct("<IHH")
#: Reward, end, won.
STATE_HEAD = struct.Struct("<fBB")
#: More is never sent.
BODY_MAX = 1 << 26

#: Answers wait for each other, up to so many bytes.
UNSENT_MAX = 1 << 18

# From the program.
HELLO, OPEN, RESET, STEP, CLOSE = range(5)
# To it.
WELCOME, OPENED, STATE, FAILED = range(4)

#: Linux: which signal a process gets when the thread that has started it ends.
PR_SET_PDEATHSIG = 1

#: Of the episodes by which it is found out whether an environment is reproducible.
PROBE_SEED = 7

GOES_ON, TERMINATED, TRUNCATED = range(3)


class Closed(Exception):
    """The program has gone."""


class Opened:
    """An environment, and the sizes that the program knows it by."""

    def __init__(self, env: EntityEnv, n_features: int, n_actions: int) -> None:
        self.env = env
        self.n, self.m = int(env.n_agents), int(env.n_entities)
        self.own_features, self.own_actions = int(env.n_features), int(env.n_actions)
        # Tasks that have fewer than others are filled up.
        self.n_features = n_features or self.own_features
        self.n_actions = n_actions or self.own_actions
        self.shapes = {"observable": (self.n, self.m), "available": (self.n, self.own_actions)}
        self.fillings = {"observable": 0, "available": self.n_actions - self.own_actions}
        self.everything = {name: self._filled(name, np.ones(shape, np.uint8)) for name, shape in self.shapes.items()}
        self.steps_max, self.steps = int(env.steps_max), 0
        if self.own_features > self.n_features or self.own_actions > self.n_actions:
            raise ValueError(
                f"the environment has {self.own_features} features and {self.own_actions} actions now, and had at most "
                f"{self.n_features} and {self.n_actions} when the run began"
            )

    def reset(self, seed: int) -> bytes:
        self.steps = 0
        state = self.env.reset(seed)
        if not isinstance(state, State):
            raise TypeError(f"reset returned {type(state).__name__}, not rit.env.State")
        return self._encode(Step(state, 0.0))

    def step(self, actions: bytes) -> bytes:
        if len(actions) != self.n:
            raise ValueError(f"{len(actions)} actions for {self.n} agents")
        step = self.env.step(np.frombuffer(actions, np.uint8).astype(np.int64))
        if not isinstance(step, Step):
            raise TypeError(f"step returned {type(step).__name__}, not rit.env.Step")
        self.steps += 1
        if self.steps >= self.steps_max and not step.terminated:
            step.truncated = True
        return self._encode(step)

    def _encode(self, step: Step) -> bytes:
        state = step.state
        entities = np.asarray(state.entities, np.float32)
        if entities.shape != (self.m, self.own_features):
            raise ValueError(f"entities has the shape {entities.shape}, not {(self.m, self.own_features)}")
        if self.n_features > self.own_features:
            filling = np.zeros((self.m, self.n_features - self.own_features), np.float32)
            entities = np.hstack([entities, filling])
        observable = self._flags("observable", state.observable)
        available = self._flags("available", state.available)
        end = TERMINATED if step.terminated else TRUNCATED if step.truncated else GOES_ON
        head = STATE_HEAD.pack(step.reward, end, bool(step.won))
        return b"".join((head, entities.tobytes(), observable, available))

    def _flags(self, name: str, given: Any) -> bytes:
        if given is None:
            return self.everything[name]
        flags, shape = np.asarray(given), self.shapes[name]
        if flags.shape != shape:
            raise ValueError(f"{name} has the shape {flags.shape}, not {shape}")
        # The program looks at bytes for itself.
        if flags.dtype != np.uint8:
            if not np.isin(flags, (0, 1)).all():
                raise ValueError(f"{name} must be 0 or 1 everywhere")
            flags = flags.astype(np.uint8)
        return self._filled(name, flags)

    def _filled(self, name: str, flags: np.ndarray) -> bytes:
        filling = self.fillings[name]
        if filling:
            flags = np.hstack([flags, np.zeros((self.n, filling), np.uint8)])
        return flags.tobytes()


class Worker:
    """Answers frames until the program has gone."""

    def __init__(self, make: str, requests: int, answers: int) -> None:
        self._make_name, self._requests, self._answers = make, requests, answers
        self._make: Any = None
        #: Read; answered up to here.
        self._unread, self._at = b"", 0
        #: Answered, and not sent yet.
        self._unsent = bytearray()
        self._opened: dict[int, Opened] = {}

    def run(self) -> None:
        while True:
            length, kind, index = HEADER.unpack(self._read(HEADER.size))
            if length > BODY_MAX:
                raise ValueError(f"a frame of {length} bytes")
            body = self._read(length)
            try:
                answer = self._answer(kind, index, body)
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                self._write(FAILED, index, _explained(error))
            else:
                if answer is not None:
                    self._write(*answer)

    def _answer(self, kind: int, index: int, body: bytes) -> tuple[int, int, bytes] | None:
        if kind == STEP:
            return STATE, index, self._opened[index].step(body)
        if kind == RESET:
            return STATE, index, self._opened[index].reset(*struct.unpack("<Q", body))
        if kind == HELLO:
            version = json.loads(body)["protocol"]
            if version != PROTOCOL_VERSION:
                raise ValueError(f"the program speaks protocol {version}, this package {PROTOCOL_VERSION}: install the same")
            self._make = _load(self._make_name)
            return WELCOME, index, json.dumps({"protocol": PROTOCOL_VERSION, "python": sys.version.split()[0]}).encode()
        if kind == OPEN:
            return OPENED, index, self._open(index, json.loads(body))
        if kind == CLOSE:
            opened = self._opened.pop(index, None)
            if opened is not None:
                opened.env.close()
            return None
        raise ValueError(f"a frame of kind {kind}")

    def _open(self, index: int, wanted: dict[str, Any]) -> bytes:
        env = self._new(wanted["task"])
        opened = Opened(env, int(wanted.get("n_features", 0)), int(wanted.get("n_actions", 0)))
        described = {
            "n_agents": opened.n,
            "n_entities": opened.m,
            "n_features": opened.own_features,
            "n_actions": opened.own_actions,
            "steps_max": opened.steps_max,
            "has_wins": bool(env.has_wins),
            "feature_names": _names(env.feature_names, opened.own_features, "feature"),
            "action_names": _names(env.action_names, opened.own_actions, "action"),
        }
        if wanted.get("describe"):
            described["is_reproducible"] = self._is_reproducible(opened, wanted["task"])
        self._opened[index] = opened
        return json.dumps(described).encode()

    def _new(self, task: str) -> EntityEnv:
        env = self._make(task)
        if isinstance(env, EntityEnv):
            return env
        if hasattr(env, "possible_agents") and hasattr(env, "step"):
            return ParallelAdapter(env)
        raise TypeError(f"{self._make_name} returned {type(env).__name__}, neither a rit.env.EntityEnv nor a ParallelEnv")

    def _is_reproducible(self, first: Opened, task: str) -> bool:
        """Whether two environments roll the same beginning of an episode from the same seed."""
        second = Opened(self._new(task), first.n_features, first.n_actions)
        rng = np.random.default_rng(1)
        states = [opened.reset(PROBE_SEED) for opened in (first, second)]
        for _ in range(min(first.steps_max, 25)):
            if states[0] != states[1]:
                return False
            if states[0][4] != GOES_ON:
                break
            available = np.frombuffer(states[0][-first.n * first.n_actions :], np.uint8).reshape(first.n, -1)
            actions = bytes(int(rng.choice(np.flatnonzero(row))) if row.any() else 0 for row in available)
            states = [opened.step(actions) for opened in (first, second)]
        second.env.close()
        return states[0] == states[1]

    def _read(self, length: int) -> bytes:
        while len(self._unread) - self._at < length:
            # Nothing is left to do, so what was done is told: the answers to a round of requests in one go.
            self._flush()
            part = os.read(self._requests, 1 << 16)
            if not part:
                raise Closed
            self._unread, self._at = self._unread[self._at :] + part, 0
        begin, self._at = self._at, self._at + length
        return self._unread[begin : self._at]

    def _write(self, kind: int, index: int, body: bytes) -> None:
        self._unsent += HEADER.pack(len(body), kind, index)
        self._unsent += body
        if len(self._unsent) > UNSENT_MAX:
            self._flush()

    def _flush(self) -> None:
        while self._unsent:
            try:
                del self._unsent[: os.write(self._answers, self._unsent)]
            except BrokenPipeError:
                raise Closed from None


def _load(name: str) -> Any:
    module, _, function = name.partition(":")
    if not module or not function:
        raise ValueError(f'environment.python = {name!r}; write "module:function"')
    # As `python` itself has it: what lies in the current folder can be imported.
    sys.path.insert(0, os.getcwd())
    found = importlib.import_module(module)
    for part in function.split("."):
        found = getattr(found, part)
    return found


def _names(names: Any, count: int, what: str) -> list[str]:
    names = [f"{what}.{index}" for index in range(count)] if names is None else [str(name) for name in names]
    if len(names) != count:
        raise ValueError(f"{len(names)} {what}_names for {count} {what}s")
    return names


def _explained(error: BaseException) -> bytes:
    """The error in a line, where it was raised, and its traceback without the frames of this file."""
    steps = error.__traceback__
    while steps is not None and steps.tb_frame.f_code.co_filename == __file__:
        steps = steps.tb_next
    steps = steps or error.__traceback__
    text = "".join(traceback.format_exception(type(error), error, steps))
    line = " ".join(traceback.format_exception_only(type(error), error)[-1].split())
    last = traceback.extract_tb(steps)[-1:]
    place = "".join(f"{frame.filename}:{frame.lineno}, in {frame.name}" for frame in last)
    return json.dumps({"error": line[:1000], "place": place[:1000], "traceback": text[-20000:]}).encode()


def _die_with_the_program(requests: int) -> None:
    """However the program ends, and whatever an environment is doing then: this process ends too, and all that it has
    started in its process group."""
    watched = select.poll()
    watched.register(requests, 0)
    while not any(event & (select.POLLHUP | select.POLLERR) for _, event in watched.poll()):
        pass
    os.killpg(0, signal.SIGKILL)


def main() -> None:
    """What ``python -m rit.worker`` does."""
    requests, answers = os.dup(0), os.dup(1)
    # Prints of environments must not be taken for answers, nor their reads for requests.
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    memory = int(os.environ.get("RIT_WORKER_MEMORY_MB", "0"))
    if memory > 0:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory << 20, memory << 20))
    # An environment that never lets Python run again must not outlive the program either.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getpgrp() == os.getpid():
        threading.Thread(target=_die_with_the_program, args=(requests,), daemon=True).start()
    try:
        Worker(sys.argv[1], requests, answers).run()
    except Closed:
        pass


if __name__ == "__main__":
    main()
