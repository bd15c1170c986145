"""Runs for Weights & Biases, written down without a network. Skipped without `pip install wandb`."""

import json
import subprocess
import sys

import pytest
from conftest import train

from rit.mlflow import scalars

pytest.importorskip("wandb")


def test_an_offline_run_holds_what_the_run_says(tmp_path):
    from wandb.proto import wandb_internal_pb2
    from wandb.sdk.internal.datastore import DataStore

    run_dir, _ = train(tmp_path, "matrix-game", "--steps", 1000, "--set", "learner.metrics_every_env_steps=200")
    command = [sys.executable, "-m", "rit.wandb", "--run", str(run_dir), "--dir", str(tmp_path)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True).stdout
    (file,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    assert said == f"`wandb sync {file.parent}` uploads it\n"
    store, history, run = DataStore(), [], None
    store.open_for_scan(str(file))
    while (data := store.scan_data()) is not None:
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        if record.WhichOneof("record_type") == "run":
            run = record.run
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            history.append({item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in items})
    lines = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    assert (run.run_id, run.display_name, run.project) == (lines[0]["run_id"], "run", "rit")
    expected = [{**scalars(line), "env_steps": line["env_steps"]} for line in lines if scalars(line)]
    assert [{name: row[name] for name in row if not name.startswith("_")} for row in history] == expected
    assert len(expected) > 2
