"""Copies a run to an MLflow server: ``python -m rit.mlflow --run DIR --uri http://localhost:5000``.

It follows a live run until that has ended, or copies a finished one. It only reads the run directory, so whatever becomes of
the server, training goes on. Begun again it goes on with the same MLflow run. Names and steps are TensorBoard's: measures
over environment steps. ``MLFLOW_TRACKING_TOKEN``, or ``MLFLOW_TRACKING_USERNAME`` and ``MLFLOW_TRACKING_PASSWORD``, are shown
to the server, as its own client does.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import re
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rit._command import Failed, run_command, say

#: How the program says a run ended, and what MLflow calls that.
STATUS = {"finished": "FINISHED", "until": "FINISHED", "stopped": "KILLED", "interrupted": "KILLED", "failed": "FAILED"}
#: The most that one request takes.
METRICS_MAX, PARAMS_MAX, VALUE_MAX = 1000, 100, 6000
#: The tag by which a run is found again, and how far it has been copied.
RUN_ID, COPIED = "rit.run_id", "rit.copied_env_steps"
PROGRESS = ("kind", "env_steps", "episodes", "updates", "wall_s", "epsilon", "tasks")


class Server:
    """MLflow's HTTP interface. A server that is away for a while is waited for."""

    def __init__(self, uri: str, patience_s: float) -> None:
        self.root = uri.rstrip("/") + "/api/2.0/mlflow/"
        self.patience_s = patience_s
        self.headers = {"Content-Type": "application/json"}
        token, user = os.environ.get("MLFLOW_TRACKING_TOKEN"), os.environ.get("MLFLOW_TRACKING_USERNAME")
        if token:
            self.headers["Authorization"] = f"Bearer {token}"
        elif user:
            both = f"{user}:{os.environ.get('MLFLOW_TRACKING_PASSWORD', '')}"
            self.headers["Authorization"] = "Basic " + base64.b64encode(both.encode()).decode()

    def get(self, path: str, **query: str) -> dict[str, Any]:
        return self._ask(f"{path}?{urllib.parse.urlencode(query)}", None)

    def post(self, path: str, **body: Any) -> dict[str, Any]:
        return self._ask(path, json.dumps(body).encode())

    def _ask(self, path: str, body: bytes | None) -> dict[str, Any]:
        deadline, wait_s = time.monotonic() + self.patience_s, 0.5
        while True:
            try:
                asked = urllib.request.Request(self.root + path, body, self.headers)
                with urllib.request.urlopen(asked, timeout=30) as answer:
                    return json.load(answer)
            except urllib.error.HTTPError as error:
                said = error.read(2000).decode(errors="replace")
                if error.code == 404 and "RESOURCE_DOES_NOT_EXIST" in said:
                    return {}
                problem, passes = f"{error.code} {error.reason}: {said}", error.code in (429, 502, 503, 504)
            except (OSError, ValueError) as error:
                problem, passes = str(getattr(error, "reason", error)), True
            if not passes or time.monotonic() + wait_s > deadline:
                raise Failed(f"{self.root}: {problem}")
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, 30.0)


class Lines:
    """Whole lines of a file that grows, and that a restarted learner cuts at its checkpoint: then it is read anew."""

    def __init__(self, path: Path) -> None:
        self.path, self.at, self.last = path, 0, b""

    def new(self) -> Iterator[bytes]:
        try:
            file = open(self.path, "rb")
        except FileNotFoundError:
            return
        with file:
            file.seek(self.at - len(self.last))
            if file.read(len(self.last)) != self.last:
                self.at, self.last = 0, b""
                file.seek(0)
            for line in file:
                if not line.endswith(b"\n"):
                    return
                self.at, self.last = self.at + len(line), line
                yield line


def objects(lines: Iterable[bytes]) -> list[dict[str, Any]]:
    """The lines that hold a JSON object; a line that was torn when the machine lost power is left out."""
    found = []
    for line in lines:
        try:
            said = json.loads(line)
        except ValueError:
            continue
        if isinstance(said, dict):
            found.append(said)
    return found


def read_summary(run: Path) -> dict[str, Any] | None:
    """How the run ended, if it has."""
    path = run / "summary.json"
    try:
        said = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise Failed(f"{path} cannot be read: {error}") from None
    if not isinstance(said, dict):
        raise Failed(f"{path} cannot be read: it holds no JSON object")
    return said


def scalars(line: dict[str, Any]) -> dict[str, float]:
    """What a line says, under TensorBoard's names."""
    found: dict[str, Any] = {}
    kind, tasks = line.get("kind"), line.get("tasks", {})
    if kind == "training":
        found = {f"training/{name}": value for name, value in line.items() if name not in PROGRESS}
        found |= {f"training/{name}": line.get(name) for name in ("epsilon", "episodes", "updates")}
        group = "exploring"
    elif kind == "evaluation" and line.get("occasion", "scheduled") == "scheduled":
        group = "greedy"
    else:
        return {}
    for task, result in tasks.items():
        found[f"{group}_return/{task}"] = result.get("mean_return")
        found[f"{group}_win_rate/{task}"] = result.get("win_rate")
    return {name: value for name, value in found.items() if isinstance(value, (int, float))}


class Copy:
    """One run on the server."""

    def __init__(self, server: Server, experiment: str, run: Path, header: dict[str, Any]) -> None:
        self.server = server
        known = server.get("experiments/get-by-name", experiment_name=experiment).get("experiment")
        of = known["experiment_id"] if known else server.post("experiments/create", name=experiment)["experiment_id"]
        condition = f"tags.`{RUN_ID}` = '{header['run_id']}'"
        found = server.post("runs/search", experiment_ids=[of], filter=condition, max_results=1).get("runs")
        if not found:
            tags = [{"key": RUN_ID, "value": header["run_id"]}, {"key": "rit.run_dir", "value": str(run.resolve())}]
            now = int(1000 * time.time())
            made = server.post("runs/create", experiment_id=of, run_name=run.resolve().name, start_time=now, tags=tags)
            found = [made["run"]]
        (mlflow_run,) = found
        self.id, self.started = mlflow_run["info"]["run_id"], int(mlflow_run["info"]["start_time"])
        self.page = f"{server.root.removesuffix('api/2.0/mlflow/')}#/experiments/{of}/runs/{self.id}"
        data = mlflow_run.get("data", {})
        tags = {tag["key"]: tag["value"] for tag in data.get("tags", [])}
        self.copied = int(tags.get(COPIED, -1))
        server.post("runs/update", run_id=self.id, status="RUNNING")
        # What is there may not be changed: keys such as training.t_max may be other ones after a resume.
        there = {param["key"] for param in data.get("params", [])}
        params = [
            {"key": key, "value": str(value)[:VALUE_MAX]}
            for key, value in header.get("settings", {}).items()
            if key not in there
        ]
        for begin in range(0, len(params), PARAMS_MAX):
            server.post("runs/log-batch", run_id=self.id, params=params[begin : begin + PARAMS_MAX])

    def send(self, lines: list[dict[str, Any]]) -> None:
        """Copies lines, those left out that the server has. Sent again, the same point is the same."""
        metrics = []
        for line in lines:
            if line.get("env_steps", -1) >= self.copied:
                at = self.started + int(1000 * (line.get("wall_s") or 0.0))
                said = scalars(line).items()
                metrics += [self._metric(name, value, at, line["env_steps"]) for name, value in said]
        for begin in range(0, len(metrics), METRICS_MAX):
            self.server.post("runs/log-batch", run_id=self.id, metrics=metrics[begin : begin + METRICS_MAX])
        if metrics:
            self.copied = metrics[-1]["step"]
            self.server.post("runs/set-tag", run_id=self.id, key=COPIED, value=str(self.copied))

    def end(self, summary: dict[str, Any]) -> None:
        """Says how the run ended, and what it came to."""
        steps, at = summary.get("env_steps", 0), self.started + int(1000 * summary.get("wall_s", 0.0))
        results = summary.get("evaluation", {}).items()
        final = [(f"final_{key}/{task}", result.get(name))
                 for task, result in results for key, name in (("return", "mean_return"), ("win_rate", "win_rate"))]  # fmt: skip
        metrics = [self._metric(name, value, at, steps) for name, value in final if value is not None]
        words = {f"rit.{key}": summary[key] for key in ("ended", "reason", "weights_digest") if summary.get(key)}
        tags = [{"key": key, "value": str(value)[:VALUE_MAX]} for key, value in words.items()]
        self.server.post("runs/log-batch", run_id=self.id, metrics=metrics, tags=tags)
        status = STATUS.get(summary.get("ended", ""), "FINISHED")
        self.server.post("runs/update", run_id=self.id, status=status, end_time=at)

    def _metric(self, name: str, value: float, at: int, step: int) -> dict[str, Any]:
        return {"key": re.sub(r"[^-_. /0-9A-Za-z]", "_", name), "value": value, "timestamp": at, "step": step}


def follow(run: Path, server: Server, experiment: str, once: bool, every_s: float) -> None:
    """Copies a run until it has ended, or what is there now."""
    lines, copy, sent = Lines(run / "metrics.jsonl"), None, 0
    while True:
        if not run.is_dir():
            raise Failed(f"{run} is gone")
        # Looked for first: what was written before it is read below.
        summary = read_summary(run)
        new = objects(lines.new())
        for header in (line for line in new if line.get("kind") == "run"):
            if copy is None:
                copy = Copy(server, experiment, run, header)
                say(copy.page)
        if copy is None and (once or summary):
            raise Failed(f"{run}/metrics.jsonl does not say whose it is: there is no run, or an older build wrote it")
        if copy is not None:
            copy.send(new)
            sent += len(new)
            if summary:
                copy.end(summary)
            if summary or once:
                say(f"{sent} lines copied; the run {'has ended: ' + summary['ended'] if summary else 'goes on'}")
                return
        time.sleep(every_s)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m rit.mlflow", description=__doc__.split("\n\n")[0])
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="run directory, of a live or a finished run")
    parser.add_argument("--uri", required=True, help="the server, such as http://localhost:5000")
    parser.add_argument("--experiment", default="rit", help="MLflow's experiment, which is made if it is not there")
    parser.add_argument("--once", action="store_true", help="copy what is there now, and do not follow")
    parser.add_argument("--every", type=float, default=5.0, metavar="S", help="seconds between two looks at the run")
    parser.add_argument("--patience", type=float, default=600.0, metavar="S", help="seconds that a server may be away")
    options = parser.parse_args(arguments)
    if not re.match("https?://", options.uri):
        parser.error(f"--uri {options.uri}: write http://HOST:PORT")
    if not options.run.is_dir():
        parser.error(f"--run {options.run}: there is no such folder")

    def copy() -> None:
        server = Server(options.uri, options.patience)
        follow(options.run, server, options.experiment, options.once, max(options.every, 0.1))

    return run_command(copy)


if __name__ == "__main__":
    sys.exit(main())
