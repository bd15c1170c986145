"""Checkpoints in an object store: a folder as one, and nanio, a server with S3's own protocol, signatures included."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import RIT, rit

from rit.copy import Failed, fetch, main

pytest.importorskip("obstore")
SERVER = Path(sys.executable).parent / "nanio"
KEYS = {"AWS_ACCESS_KEY_ID": "rit", "AWS_SECRET_ACCESS_KEY": "a secret of the test's", "AWS_REGION": "us-east-1"}
SETTINGS = ["--set", "web.listen=off", "--set", "evaluation.episodes=2", "--set", "checkpoints.every_env_steps=400"]


def train(run, *arguments):
    done = rit("train", "--json", *arguments, "--actors", 1, *SETTINGS)
    assert json.loads(done.stdout)["ended"] == "finished"
    return json.loads((run / "summary.json").read_text())["weights_digest"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of 800 steps; other tests only read it."""
    run = tmp_path_factory.mktemp("copied") / "run"
    train(run, "matrix-game", "--seed", 3, "--steps", 800, "--run-dir", run)
    return run


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The digest of 1200 steps at once."""
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    return train(run, "matrix-game", "--seed", 3, "--steps", 1200, "--run-dir", run)


def copied(run, url, *arguments):
    return main(["--run", str(run), "--to", url, "--patience", "0", "--every", "0.1", *arguments])


def stored(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


class Server:
    """A real S3 server over a folder, on a port that stays."""

    def __init__(self, folder):
        self.folder = folder
        (folder / "bucket").mkdir()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.process = None

    def start(self):
        keys = {"NANIO_ACCESS_KEY": KEYS["AWS_ACCESS_KEY_ID"], "NANIO_SECRET_KEY": KEYS["AWS_SECRET_ACCESS_KEY"]}
        place = ["--host", "127.0.0.1", "--port", str(self.port), "--data-dir", self.folder, "--no-access-log"]
        self.process = subprocess.Popen(
            [SERVER, "serve", *place], env={**os.environ, **keys}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        deadline = time.monotonic() + 60
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
                return
            except OSError:
                assert time.monotonic() < deadline and self.process.poll() is None, "the server does not come up"
                time.sleep(0.05)

    def stop(self):
        self.process.kill()
        self.process.wait()


@pytest.fixture
def server(tmp_path, monkeypatch):
    if not SERVER.exists():
        pytest.skip("nanio is not installed")
    folder = tmp_path / "buckets"
    folder.mkdir()
    server = Server(folder)
    for key, value in {**KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.port}"}.items():
        monkeypatch.setenv(key, value)
    server.start()
    yield server
    server.stop()


def test_what_is_fetched_goes_on_to_the_same_weights(run, undisturbed, tmp_path, capsys):
    url = f"file://{tmp_path}/store"
    assert copied(run, url, "--once") == 0
    assert "step-000000000800 copied" in capsys.readouterr().out
    assert copied(run, url) == 0, "a run that has ended is not waited for"
    assert " 0 bytes sent" in capsys.readouterr().out, "nothing has changed"
    back = tmp_path / "back"
    assert main(["--from", url, "--run", str(back)]) == 0
    assert (back / "token").read_text() != (run / "token").read_text()
    assert oct((back / "token").stat().st_mode & 0o777) == oct(0o600) and oct(back.stat().st_mode & 0o777) == oct(0o700)
    assert train(back, "--resume", back, "--steps", 1200) == undisturbed


def test_a_copy_cut_off_half_way_or_altered_does_not_count(run, tmp_path, capsys):
    store = tmp_path / "store"
    url = f"file://{store}"
    assert copied(run, url, "--once") == 0
    whole = stored(store)
    # One that was cut off: files, and no list of them.
    (store / "checkpoints/step-000000000800.json").rename(tmp_path / "list")
    assert main(["--from", url, "--run", str(tmp_path / "a"), "--patience", "0"]) == 1
    assert "holds no copy" in capsys.readouterr().err and not (tmp_path / "a").exists()
    # A newer one with a file that is gone, altered, or shorter: the one before is taken.
    (tmp_path / "list").rename(store / "checkpoints/step-000000000800.json")
    listed = json.loads((store / "checkpoints/step-000000000800.json").read_text())
    listed["checkpoint"] = "step-000000000900"
    for at, (content, words) in enumerate([(None, "not found"), (b"x" * 40, "was altered"), (b"x", "was altered")]):
        digest = "ab" * 32
        listed["files"][0] |= {"sha256": digest, "bytes": 40}
        (store / "checkpoints/step-000000000900.json").write_text(json.dumps(listed))
        if content is not None:
            (store / "files" / digest).write_bytes(content)
        assert main(["--from", url, "--run", str(tmp_path / f"b{at}"), "--patience", "0"]) == 0
        said = capsys.readouterr()
        assert "step-000000000800 fetched" in said.out and words in said.err
        assert main(["--from", url, "--run", str(tmp_path / f"c{at}"), "--at", "900", "--patience", "0"]) == 1
        assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == [], "nothing is left lying"
    # What is there besides is swept out by the next copy.
    (store / "checkpoints/step-000000000900.json").unlink()
    assert copied(run, url, "--once") == 0
    assert stored(store) == whole


def test_later_checkpoints_at_the_same_step_are_copied_and_the_last_of_them_is_the_newest(run, undisturbed, tmp_path, capsys):
    again, store = tmp_path / "run", tmp_path / "store"
    url = f"file://{store}"
    shutil.copytree(run, again, symlinks=True, ignore=shutil.ignore_patterns("*.sock"))
    assert copied(again, url, "--once", "--keep", "2") == 0
    latest = again / "checkpoints/latest"
    first = os.readlink(latest)
    names = [f"{first}-{repetition}" for repetition in (2, 9, 10)]
    for name in names:
        shutil.copytree(again / "checkpoints" / first, again / "checkpoints" / name)
        latest.unlink()
        latest.symlink_to(name)
        assert copied(again, url, "--once", "--keep", "2") == 0
        assert f"{name} copied" in capsys.readouterr().out
    assert sorted(path.name for path in (store / "checkpoints").iterdir()) == [f"{first}-10.json", f"{first}-9.json"]
    for at, arguments in enumerate([[], ["--at", "800"]]):
        back = tmp_path / f"back{at}"
        assert main(["--from", url, "--run", str(back), *arguments]) == 0
        assert os.readlink(back / "checkpoints/latest") == names[-1]
    assert train(back, "--resume", back, "--steps", 1200) == undisturbed


@pytest.mark.parametrize("path", ["../out", "/out", "learner.sock", "checkpoints/../../out", "replay/x", "token"])
def test_a_list_from_outside_writes_nothing_elsewhere(run, tmp_path, path):
    url = f"file://{tmp_path}/store"
    assert copied(run, url, "--once") == 0
    name = tmp_path / "store/checkpoints/step-000000000800.json"
    listed = json.loads(name.read_text())
    listed["files"][0]["path"] = path
    name.write_text(json.dumps(listed))
    with pytest.raises(Failed, match="holds no copy that is whole"):
        fetch(url, tmp_path / "back", None, 0.0)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["store"]


def test_one_prefix_is_for_one_run(run, matrix_run, tmp_path, capsys):
    url = f"file://{tmp_path}/store"
    assert copied(run, url, "--once") == 0
    assert copied(matrix_run, url, "--once") == 1
    assert "holds copies of another run" in capsys.readouterr().err


def test_a_store_that_is_away_is_said_and_counted_and_ends_nothing(run, capsys, monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free.getsockname()[1]}")
    for key, value in KEYS.items():
        monkeypatch.setenv(key, value)
    assert copied(run, "s3://bucket/prefix", "--once", "--patience", "1") == 1
    said = capsys.readouterr().err
    assert "warning: not copied (1 so far): s3://bucket/prefix" in said and "error: the newest checkpoint was not copied" in said
    assert "a secret" not in said
    assert copied(run, "nowhere://x") == 1 and "nowhere://x" in capsys.readouterr().err


def test_a_live_run_is_copied_to_a_real_s3_server_that_goes_and_comes(server, undisturbed, tmp_path):
    run, url = tmp_path / "run", "s3://bucket/runs/one"
    training = subprocess.Popen(
        [RIT, "train", "matrix-game", "--json", "--seed", "3", "--steps", "1200", "--run-dir", run, "--actors", "1", *SETTINGS],
        stdout=subprocess.DEVNULL,
    )
    copying = None
    try:
        while not (run / "run_id").exists():
            time.sleep(0.02)
        command = [sys.executable, "-m", "rit.copy", "--run", run, "--to", url, "--every", "0.1", "--keep", "2"]
        copying = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
        assert copying.stdout.readline().startswith("step-")
        server.stop()
        assert training.wait(120) == 0, "training does not wait for a store"
        server.start()
        said = copying.communicate(timeout=120)[0].splitlines()
        assert copying.returncode == 0 and said[-1].startswith("step-000000001200 copied"), said
    finally:
        for process in filter(None, (training, copying)):
            process.send_signal(signal.SIGKILL)
            process.wait()
    lists = [name for name in stored(server.folder) if name.startswith("bucket/runs/one/checkpoints/")]
    assert 1 <= len(lists) <= 2, "as many as are kept"
    back = tmp_path / "elsewhere"
    # The machine that trained is gone.
    os.rename(run, tmp_path / "gone")
    assert main(["--from", url, "--run", str(back)]) == 0
    assert json.loads((back / "summary.json").read_text())["weights_digest"] == undisturbed
    further = train(back, "--resume", back, "--steps", 1600)
    at_once = tmp_path / "at_once"
    assert further == train(at_once, "matrix-game", "--seed", 3, "--steps", 1600, "--run-dir", at_once)


def test_wrong_keys_are_said(server, run, monkeypatch, capsys):
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "another")
    assert copied(run, "s3://bucket/runs/two", "--once") == 1
    assert "warning: not copied" in capsys.readouterr().err
    assert not any(path.is_file() for path in Path(server.folder / "bucket").rglob("*"))


def test_it_copies_although_what_it_says_is_not_read(run, tmp_path):
    reads, writes = os.pipe()
    os.close(reads)
    with open(writes, "wb") as closed:
        command = [sys.executable, "-m", "rit.copy", "--run", run, "--to", f"file://{tmp_path}/store"]
        copying = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, timeout=60)
    assert (copying.returncode, copying.stderr) == (0, b"")
    assert any(name.startswith("checkpoints/") for name in stored(tmp_path / "store"))


def test_a_list_that_cannot_be_read_is_named(run, tmp_path, capsys):
    url = f"file://{tmp_path}/store"
    assert copied(run, url) == 0
    (listed,) = (tmp_path / "store" / "checkpoints").iterdir()
    listed.write_text("[]")
    assert copied(run, url) == 1
    assert f"{listed.name} cannot be read" in capsys.readouterr().err
