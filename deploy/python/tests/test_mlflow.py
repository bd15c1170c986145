"""Runs on an MLflow server. The tests with a real server need `pip install mlflow`, and are skipped without."""

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from conftest import RIT

from rit import wandb
from rit.mlflow import Lines, main, objects, read_summary, scalars

PROGRAM = Path(sys.executable).parent / "mlflow"
FOLLOW = [sys.executable, "-m", "rit.mlflow", "--every", "0.2"]


def until(ready, seconds=240):
    """Waits until something is so."""
    deadline = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.1)


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    """The address of a real server with an empty store."""
    pytest.importorskip("mlflow")
    if not PROGRAM.exists():
        pytest.skip("mlflow is installed without its server")
    folder = tmp_path_factory.mktemp("mlflow")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    arguments = ["--host", "127.0.0.1", "--port", port, "--workers", "1"]
    stores = ["--backend-store-uri", f"sqlite:///{folder}/runs.db", "--artifacts-destination", str(folder / "files")]
    with open(folder / "log", "wb") as log:
        server = subprocess.Popen([PROGRAM, "server", *arguments, *stores], stdout=log, stderr=log, start_new_session=True)

    def answers():
        assert server.poll() is None, (folder / "log").read_text()
        try:
            return urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5).status == 200
        except OSError:
            return False

    try:
        until(answers)
        yield f"http://127.0.0.1:{port}"
    finally:
        subprocess.run(["kill", "--", f"-{server.pid}"], check=False)
        server.wait(60)


def test_a_live_run_is_followed_to_its_end_by_followers_that_come_and_go(uri, tmp_path):
    import mlflow

    run = tmp_path / "run"
    settings = ["--set", "learner.metrics_every_env_steps=200", "--set", "evaluation.episodes=4", "--set", "web.listen=off"]
    training = subprocess.Popen([RIT, "train", "matrix-game", "--json", "--steps", "8000", "--run-dir", run, *settings],
                                stdout=subprocess.DEVNULL)  # fmt: skip
    try:
        until((run / "metrics.jsonl").exists)
        asked = ["--run", str(run), "--uri", uri, "--experiment", "live"]
        first = subprocess.Popen([*FOLLOW, *asked], stdout=subprocess.PIPE, text=True)
        assert first.stdout.readline().startswith(f"{uri}/#/experiments/")
        first.send_signal(signal.SIGINT)
        assert first.wait(60) == 130
        second = subprocess.run([*FOLLOW, *asked], capture_output=True, text=True, timeout=240)
        assert second.returncode == 0 and second.stdout.endswith("the run has ended: finished\n"), second.stderr
        assert training.wait(60) == 0
    finally:
        training.kill()
        training.wait()
    client = mlflow.MlflowClient(uri)
    (experiment,) = client.search_experiments(filter_string="name = 'live'")
    (copied,) = client.search_runs([experiment.experiment_id])
    summary = json.loads((run / "summary.json").read_text())
    assert (copied.info.status, copied.info.run_name) == ("FINISHED", "run")
    assert copied.data.tags["rit.weights_digest"] == summary["weights_digest"]
    assert copied.data.params["algorithm.name"] == "rit" and copied.data.params["training.t_max"] == "8000"
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for name in ("training/td_loss", "training/epsilon", "exploring_return/game-2", "greedy_return/game-3"):
        expected = [(line["env_steps"], scalars(line)[name]) for line in lines if name in scalars(line)]
        history = client.get_metric_history(copied.info.run_id, name)
        assert sorted((point.step, point.value) for point in history) == expected and len(expected) > 1, name
    final = client.get_metric_history(copied.info.run_id, "final_return/game-1")
    assert [point.value for point in final] == [summary["evaluation"]["game-1"]["mean_return"]]


def test_names_are_tensorboards():
    result = {"episodes": 4, "mean_return": 2.5, "win_rate": 0.25, "policy_lag": 1}
    training = {"kind": "training", "env_steps": 8, "episodes": 4, "updates": 3, "wall_s": 1.0, "epsilon": 0.5,
                "tasks": {"a": result}, "td_loss": 7.0, "grad_norm": None}  # fmt: skip
    assert scalars(training) == {
        "training/td_loss": 7.0,
        "training/epsilon": 0.5,
        "training/episodes": 4,
        "training/updates": 3,
        "exploring_return/a": 2.5,
        "exploring_win_rate/a": 0.25,
    }
    evaluation = {"kind": "evaluation", "env_steps": 8, "tasks": {"a": result, "b": {"mean_return": None}}}
    assert scalars(evaluation) == {"greedy_return/a": 2.5, "greedy_win_rate/a": 0.25}
    assert scalars({**evaluation, "occasion": "final"}) == scalars({"kind": "else"}) == {}


def test_a_file_that_grows_and_is_cut_is_read_whole(tmp_path):
    file = tmp_path / "metrics.jsonl"
    lines = Lines(file)
    assert list(lines.new()) == []
    file.write_bytes(b"one\ntwo\nthr")
    assert list(lines.new()) == [b"one\n", b"two\n"]
    assert list(lines.new()) == []
    with open(file, "ab") as more:
        more.write(b"ee\n")
    assert list(lines.new()) == [b"three\n"]
    file.write_bytes(b"one\n2\nthird and longer\n")
    assert list(lines.new()) == [b"one\n", b"2\n", b"third and longer\n"], "cut at a checkpoint and grown beyond"


def test_a_torn_line_is_left_out_and_a_torn_summary_is_named(tmp_path, capsys):
    file, summary = tmp_path / "metrics.jsonl", tmp_path / "summary.json"
    file.write_bytes(b'{"kind": "evaluation"}\n{"kind": "trai\n\x00\xff\n7\n{"kind": "training"}\n{"kind": "trai')
    lines = Lines(file)
    assert objects(lines.new()) == [{"kind": "evaluation"}, {"kind": "training"}]
    with open(file, "ab") as more:
        more.write(b'ning", "env_steps": 8}\n')
    assert objects(lines.new()) == [{"kind": "training", "env_steps": 8}], "a line is read once it is whole"
    assert read_summary(tmp_path) is None
    for torn in (b'{"ended": "fin', b"\xff\xfe", b"[]"):
        summary.write_bytes(torn)
        asked = ["--run", str(tmp_path)]
        assert main([*asked, "--uri", "http://127.0.0.1:1", "--once", "--patience", "0"]) == 1
        assert f"{summary} cannot be read" in capsys.readouterr().err
        file.write_bytes(b'{"kind": "run", "run_id": "0"}\n')
        assert wandb.main([*asked, "--dir", str(tmp_path)]) == 1
        assert f"{summary} cannot be read" in capsys.readouterr().err


def test_a_server_that_is_not_there_is_said(matrix_run, capsys):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"
    assert main(["--run", str(matrix_run), "--uri", address, "--patience", "0.1"]) == 1
    assert "Connection refused" in capsys.readouterr().err
    with pytest.raises(SystemExit) as refused:
        main(["--run", "/nowhere", "--uri", address])
    assert refused.value.code == 2 and "there is no such folder" in capsys.readouterr().err
