"""A process that holds environments: ``python -m rit.worker MODULE:MAKE``, started by ``rit``.

Frames come on standard input and go to what standard output was; ``deploy/docs/environments.md`` has the protocol. What
environments print goes to standard error.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import select
import signal
import struct
import sys
import threading
import time
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

#: Bytes that are read at once.
READ_MAX = 1 << 16
#: Answers wait for each other, up to so many bytes and so long.
UNSENT_MAX, UNSENT_S = 1 << 18, 0.001
#: Seconds after which answers are sent though an environment is still at work.
STALL_S = 0.2
#: Kinds of arrays that hold real numbers.
NUMBERS = "fiub"

# From the program.
HELLO, OPEN, RESET, STEP, CLOSE = range(5)
# To it.
WELCOME, OPENED, STATE, FAILED = range(4)

#: What the program marks a worker with, and all that this starts.
MARK = "RIT_WORKER_MARK"

#: Linux: which signal a process gets when the thread that has started it ends.
PR_SET_PDEATHSIG = 1

#: Of the episodes by which it is found out whether an environment is reproducible.
PROBE_SEED = 7

GOES_ON, TERMINATED, TRUNCATED = range(3)


class Closed(Exception):
    """The program has gone."""


class Opened:
    """An environment, the sizes that the program knows it by, and the frame that its states are sent in."""

    def __init__(self, env: EntityEnv, n_features: int, n_actions: int, index: int = 0) -> None:
        self.env = env
        self.n, self.m = int(env.n_agents), int(env.n_entities)
        self.own_features, self.own_actions = int(env.n_features), int(env.n_actions)
        # Tasks that have fewer than others are filled up.
        self.n_features = n_features or self.own_features
        self.n_actions = n_actions or self.own_actions
        self.steps_max, self.steps = int(env.steps_max), 0
        if self.own_features > self.n_features or self.own_actions > self.n_actions:
            raise ValueError(
                f"the environment has {self.own_features} features and {self.own_actions} actions now, and had at most "
                f"{self.n_features} and {self.n_actions} when the run began"
            )
        # An adapter need not make an array of actions that it takes apart again.
        self._takes_bytes = isinstance(env, ParallelAdapter) and type(env).step is ParallelAdapter.step
        self._lay_out(index)

    def _lay_out(self, index: int) -> None:
        """The frame of a state, made once; steps write into it by views of its parts."""
        n, m = self.n, self.m
        features, observable, available = 4 * m * self.n_features, n * m, n * self.n_actions
        length = STATE_HEAD.size + features + observable + available
        # What is in front of the frame puts the features where numbers of four bytes lie best.
        ahead = -(HEADER.size + STATE_HEAD.size) % 4
        self._bytes = bytearray(ahead + HEADER.size + length)
        HEADER.pack_into(self._bytes, ahead, length, STATE, index)
        self.frame = memoryview(self._bytes)[ahead:]
        self.body = self.frame[HEADER.size :]
        self._head_at = ahead + HEADER.size
        at = self._head_at + STATE_HEAD.size
        numbers = np.frombuffer(self._bytes, np.float32, m * self.n_features, at).reshape(m, self.n_features)
        self._features = numbers[:, : self.own_features]
        at += features
        self._observable = Flags("observable", np.frombuffer(self._bytes, np.uint8, observable, at).reshape(n, m))
        of_all = np.frombuffer(self._bytes, np.uint8, available, at + observable).reshape(n, self.n_actions)
        self._available = Flags("available", of_all[:, : self.own_actions])

    def reset(self, seed: int) -> memoryview:
        """The body of the state's frame, until the next one."""
        self.steps = 0
        state = self.env.reset(seed)
        if not isinstance(state, State):
            raise TypeError(f"reset returned {type(state).__name__}, not rit.env.State")
        return self._encode(Step(state, 0.0))

    def step(self, actions: bytes | memoryview) -> memoryview:
        """Likewise."""
        if len(actions) != self.n:
            raise ValueError(f"{len(actions)} actions for {self.n} agents")
        if self._takes_bytes:
            step = self.env._take(actions)
        else:
            step = self.env.step(np.frombuffer(actions, np.uint8).astype(np.int64))
        if not isinstance(step, Step):
            raise TypeError(f"step returned {type(step).__name__}, not rit.env.Step")
        self.steps += 1
        if self.steps >= self.steps_max and not step.terminated:
            step.truncated = True
        return self._encode(step)

    def _encode(self, step: Step) -> memoryview:
        state = step.state
        entities = state.entities
        if type(entities) is not np.ndarray or entities.dtype.kind not in NUMBERS:
            entities = _numbers(entities)
        if entities.shape != self._features.shape:
            raise ValueError(f"entities has the shape {entities.shape}, not {self._features.shape}")
        self._features[:] = entities
        self._observable.write(state.observable)
        self._available.write(state.available)
        end = TERMINATED if step.terminated else TRUNCATED if step.truncated else GOES_ON
        STATE_HEAD.pack_into(self._bytes, self._head_at, step.reward, end, bool(step.won))
        return self.body


def _numbers(entities: Any) -> np.ndarray:
    """What is no array of real numbers, as one."""
    given = np.asarray(entities)
    if given.dtype.kind not in NUMBERS and given.dtype != object:
        raise TypeError(f"entities has the dtype {given.dtype}; features are real numbers")
    return np.asarray(given, np.float32)


class Flags:
    """Flags in a frame, all set as long as nothing else is given."""

    def __init__(self, name: str, view: np.ndarray) -> None:
        self._name, self._view = name, view
        self._are_set = True
        view[:] = 1

    def write(self, given: Any) -> None:
        if given is None:
            if not self._are_set:
                self._view[:] = 1
                self._are_set = True
            return
        flags = given if type(given) is np.ndarray else np.asarray(given)
        if flags.shape != self._view.shape:
            raise ValueError(f"{self._name} has the shape {flags.shape}, not {self._view.shape}")
        # The program looks at bytes for itself.
        if flags.dtype != np.uint8 and flags.dtype != np.bool_ and not ((flags == 0) | (flags == 1)).all():
            raise ValueError(f"{self._name} must be 0 or 1 everywhere")
        self._are_set = False
        self._view[:] = flags


class Worker:
    """Answers frames until the program has gone."""

    def __init__(self, make: str, requests: int, answers: int) -> None:
        self._make_name, self._requests, self._answers = make, requests, answers
        self._make: Any = None
        #: Read, of which what lies between is not answered.
        self._read, self._at, self._end = memoryview(bytearray(READ_MAX)), 0, 0
        #: Answered, and not sent yet; the watching thread sends it too.
        self._unsent, self._sending, self._sent_s = bytearray(), threading.Lock(), 0.0
        self._opened: dict[int, Opened] = {}

    def run(self) -> None:
        while True:
            kind, index, body = self._next()
            try:
                answer = self._answer(kind, index, body)
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                answer = _framed(FAILED, index, _explained(error))
            if answer is not None:
                with self._sending:
                    self._unsent += answer
                # A slow environment must not delay its neighbours' answers; HELLO and OPEN are answered at once.
                is_late = time.monotonic() - self._sent_s > UNSENT_S
                if is_late or kind in (HELLO, OPEN) or len(self._unsent) > UNSENT_MAX:
                    self.flush()

    def _answer(self, kind: int, index: int, body: memoryview) -> bytes | memoryview | None:
        """A whole frame, if there is an answer."""
        if kind == STEP:
            opened = self._opened[index]
            opened.step(body)
            return opened.frame
        if kind == RESET:
            opened = self._opened[index]
            opened.reset(*struct.unpack("<Q", body))
            return opened.frame
        if kind == HELLO:
            version = json.loads(bytes(body))["protocol"]
            if version != PROTOCOL_VERSION:
                raise ValueError(f"the program speaks protocol {version}, this package {PROTOCOL_VERSION}: install the same")
            self._make = _load(self._make_name)
            welcome = {"protocol": PROTOCOL_VERSION, "python": sys.version.split()[0]}
            return _framed(WELCOME, index, json.dumps(welcome).encode())
        if kind == OPEN:
            return _framed(OPENED, index, self._open(index, json.loads(bytes(body))))
        if kind == CLOSE:
            opened = self._opened.pop(index, None)
            if opened is not None:
                opened.env.close()
            return None
        raise ValueError(f"a frame of kind {kind}")

    def _open(self, index: int, wanted: dict[str, Any]) -> bytes:
        env = self._new(wanted["task"])
        opened = Opened(env, int(wanted.get("n_features", 0)), int(wanted.get("n_actions", 0)), index)
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

    def _next(self) -> tuple[int, int, memoryview]:
        """The next request: its kind, its environment and its body, which is there until the one after it."""
        while True:
            begin, length = self._at + HEADER.size, 0
            if begin <= self._end:
                length, kind, index = HEADER.unpack_from(self._read, self._at)
                if length > BODY_MAX:
                    raise ValueError(f"a frame of {length} bytes")
                end = begin + length
                if end <= self._end:
                    self._at = end
                    return kind, index, self._read[begin:end]
            # Nothing is left to do, so what was done is told: the answers to a round of requests in one go.
            self.flush()
            self._fill(HEADER.size + length)

    def _fill(self, needed: int) -> None:
        """Reads what there is, into a buffer with room for so many bytes."""
        begun = bytes(self._read[self._at : self._end])
        if len(self._read) < needed:
            self._read = memoryview(bytearray(needed))
        self._at, self._end = 0, len(begun)
        if self._requests < 0:
            raise Closed
        if begun:
            self._read[: self._end] = begun
        count = os.readv(self._requests, [self._read[self._end :]])
        if not count:
            raise Closed
        self._end += count

    def leave(self) -> None:
        """What a copy of this process does: the connection is not its own."""
        for end in (self._requests, self._answers):
            os.close(end)
        self._requests = self._answers = -1
        self._sending, self._unsent = threading.Lock(), bytearray()

    def flush(self) -> None:
        """Sends what is answered."""
        with self._sending:
            while self._unsent:
                try:
                    del self._unsent[: os.write(self._answers, self._unsent)]
                except BrokenPipeError:
                    raise Closed from None
        self._sent_s = time.monotonic()


def _framed(kind: int, index: int, body: bytes) -> bytes:
    return HEADER.pack(len(body), kind, index) + body


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
    """The error in a line, where it was raised, and its traceback without the frames of this file: none where this file
    has found the fault."""
    steps = error.__traceback__
    while steps is not None and steps.tb_frame.f_code.co_filename == __file__:
        steps = steps.tb_next
    text = "".join(traceback.format_exception(type(error), error, steps))
    line = " ".join(traceback.format_exception_only(type(error), error)[-1].split())
    last = traceback.extract_tb(steps)[-1:] if steps else []
    place = "".join(f"{frame.filename}:{frame.lineno}, in {frame.name}" for frame in last)
    return json.dumps({"error": line[:1000], "place": place[:1000], "traceback": text[-20000:]}).encode()


def _watch(worker: Worker, requests: int) -> None:
    """However the program ends, and whatever an environment is doing then: this process ends too, and all that it has
    started in its process group. Meanwhile, what is answered does not wait for an environment that hangs."""
    watched = select.poll()
    watched.register(requests, 0)
    while not any(event & (select.POLLHUP | select.POLLERR) for _, event in watched.poll(1000 * STALL_S)):
        try:
            worker.flush()
        except Closed:
            break
    os.killpg(0, signal.SIGKILL)


def _keep(mark: str) -> None:
    """Leaves a process behind that waits for the end of this one, however it comes, and ends what environments have started in
    process groups of their own: all that has the mark in its environment."""
    worker = os.pidfd_open(os.getpid())
    if os.fork() != 0:
        os.close(worker)
        return
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for end in (0, 1, 2):
        os.dup2(nothing, end)
    ended = select.poll()
    ended.register(worker, select.POLLIN)
    ended.poll()
    while marked := [pid for pid in _marked(f"{MARK}={mark}".encode()) if pid != os.getpid()]:
        for pid in marked:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.01)
    os._exit(0)


def _marked(entry: bytes) -> list[int]:
    """Processes with this entry in their environment."""
    found = []
    for name in os.listdir("/proc"):
        # Others' processes cannot be read, and are not meant.
        with contextlib.suppress(OSError):
            if name.isdigit():
                with open(f"/proc/{name}/environ", "rb") as file:
                    if entry in file.read().split(b"\0"):
                        found.append(int(name))
    return found


def main() -> None:
    """What ``python -m rit.worker`` does."""
    mark = os.environ.get(MARK)
    if mark and hasattr(os, "pidfd_open"):
        # Systems without such descriptors go without.
        with contextlib.suppress(OSError):
            _keep(mark)
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
    worker = Worker(sys.argv[1], requests, answers)
    # What an environment forks must not answer in its place, nor hold the connection open when the worker has gone.
    os.register_at_fork(after_in_child=worker.leave)
    if os.getpgrp() == os.getpid():
        threading.Thread(target=_watch, args=(worker, requests), daemon=True).start()
    try:
        worker.run()
    except Closed:
        pass


if __name__ == "__main__":
    main()
