"""Writes a run down for Weights & Biases: ``python -m rit.wandb --run DIR``, then ``wandb sync`` where there is a way to their server.

It makes an offline run of theirs in the folder ``wandb`` (``--dir``), so neither an account nor a network is needed for it, and only
reads the run directory. Names and steps are TensorBoard's. It needs ``pip install wandb``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from rit._command import Failed, run_command, say
from rit.mlflow import Lines, objects, read_summary, scalars


def write(run: Path, folder: Path, project: str) -> str:
    """Writes what there is of a run; the folder of the offline run."""
    lines = objects(Lines(run / "metrics.jsonl").new())
    headers = [line for line in lines if line.get("kind") == "run"]
    if not headers:
        raise Failed(f"{run}/metrics.jsonl does not say whose it is: there is no run, or an older build wrote it")
    summary = read_summary(run) or {}
    try:
        import wandb
    except ImportError:
        raise Failed("the package wandb is not installed: pip install wandb") from None
    quiet = wandb.Settings(console="off", silent=True, disable_git=True, disable_code=True)
    # Under the run's own number, so that what is synced again is the same run there.
    theirs = wandb.init(
        mode="offline", project=project, name=run.resolve().name, id=headers[-1]["run_id"][:32], dir=folder,
        config=headers[-1].get("settings", {}), settings=quiet,
    )  # fmt: skip
    place = Path(theirs.dir).parent
    theirs.define_metric("env_steps")
    theirs.define_metric("*", step_metric="env_steps")
    for line in lines:
        said = scalars(line)
        if said:
            theirs.log({**said, "env_steps": line["env_steps"]})
    _end(theirs, summary)
    return str(place)


def _end(theirs: Any, summary: dict[str, Any]) -> None:
    for task, result in summary.get("evaluation", {}).items():
        for key, name in (("return", "mean_return"), ("win_rate", "win_rate")):
            if result.get(name) is not None:
                theirs.summary[f"final_{key}/{task}"] = result[name]
    for key in ("ended", "weights_digest"):
        if summary.get(key):
            theirs.summary[f"rit.{key}"] = summary[key]
    theirs.finish(exit_code=1 if summary.get("ended") == "failed" else 0)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m rit.wandb", description=__doc__.split("\n\n")[0])
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="run directory, of a live or a finished run")
    parser.add_argument("--dir", type=Path, default=Path(), help="where the folder wandb is made")
    parser.add_argument("--project", default="rit", help="their project")
    options = parser.parse_args(arguments)
    if not options.run.is_dir():
        parser.error(f"--run {options.run}: there is no such folder")

    def write_down() -> None:
        place = write(options.run, options.dir, options.project)
        say(f"`wandb sync {place}` uploads it")

    return run_command(write_down)


if __name__ == "__main__":
    sys.exit(main())
