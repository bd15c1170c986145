#!/usr/bin/env python3
"""Has marl-eval and rliable read a report, and holds their aggregates to the report's own.

    python3.10 -m venv venv
    printf 'setuptools<80\n' > constraints.txt
    PIP_CONSTRAINT=constraints.txt venv/bin/pip install id-marl-eval==0.0.4 rliable==1.0.8 \
        numpy==1.23.5 scipy==1.10.1 matplotlib==3.7.5 seaborn==0.12.2 statsmodels==0.14.4
    rit report DIR... --out report
    venv/bin/python deploy/checks/check_marl_eval.py report [REPLICATIONS]

marl-eval 0.0.4 asks for pandas 1.4, which has wheels up to Python 3.10. Exit code 0: every number agrees; 1: one does not.
"""

import json
import re
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import numpy as np
from matplotlib import pyplot
from marl_eval.plotting_tools import plotting
from marl_eval.utils import data_processing_utils as processing
from marl_eval.utils.diagnose_data_errors import DiagnoseData
from rliable import library, metrics

COLUMNS = ["IQM", "median", "mean", "optimality gap"]
# The report prints three decimals, and marl-eval adds 1e-6 to every span.
VALUE_TOLERANCE = 0.001
# What 50 000 replications leave to chance, doubled.
INTERVAL_TOLERANCE = 0.01


def table(path):
    """Cells of a Markdown table by their row's and column's name."""
    lines = [line for line in path.read_text().splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    head, rows = cells[0], cells[2:]
    return {row[0].lower(): dict(zip(head[1:], row[1:])) for row in rows}


def numbers(cell):
    """Value, lower end, upper end; the value alone where there is no interval."""
    return [float(text) for text in re.findall(r"-?\d+\.\d+", cell.replace("−", "-"))]


def check(report, raw, environment, replications):
    base = re.sub("-unseen$", "", environment)
    kind = "unseen" if environment.endswith("-unseen") else "training"
    path = report / "tables" / f"aggregates-{base}-{kind}.md"
    if not path.exists():
        return 0
    tasks = raw[environment]
    runs = [run for task in tasks.values() for algorithm in task.values() for run in algorithm.values()]
    wins = all("win_rate" in run["absolute_metrics"] for run in runs)
    metric, normalised = ("win_rate", []) if wins else ("return", ["return"])
    processed = processing.data_process_pipeline({environment: tasks}, normalised)
    matrices, curves = processing.create_matrices_for_rliable(processed, environment, normalised)
    plotting.performance_profiles(matrices, metric, normalised)
    plotting.sample_efficiency_curves(curves, metric, normalised)
    pyplot.close("all")
    name = f"mean_norm_{metric}" if normalised else f"mean_{metric}"
    scores = matrices[name]
    aggregates = [metrics.aggregate_iqm, metrics.aggregate_median, metrics.aggregate_mean, metrics.aggregate_optimality_gap]
    function = lambda x: np.array([aggregate(x) for aggregate in aggregates])
    values, intervals = library.get_interval_estimates(scores, function, reps=replications)
    ours, wrong = table(path), 0
    for algorithm in scores:
        for at, column in enumerate(COLUMNS):
            found = numbers(ours[algorithm][column])
            theirs = [values[algorithm][at], *intervals[algorithm][:, at]]
            off = [abs(a - b) for a, b in zip(found, theirs)]
            # The report gives a single run no interval.
            good = off[0] <= VALUE_TOLERANCE and max(off[1:], default=0) <= INTERVAL_TOLERANCE
            wrong += not good
            theirs = "{:.3f} [{:.3f}, {:.3f}]".format(*theirs)
            print(f"{'agrees ' if good else 'DIFFERS'} {environment} {algorithm} {column}: {ours[algorithm][column]}, theirs {theirs}")
    return wrong


def main():
    report = Path(sys.argv[1])
    replications = int(sys.argv[2]) if len(sys.argv) > 2 else 50000
    raw = json.loads((report / "marl-eval.json").read_text())
    diagnosis = DiagnoseData(raw).check_data()
    print("marl-eval's diagnosis:", json.dumps(diagnosis, default=str)[:2000])
    wrong = sum(check(report, raw, environment, replications) for environment in raw)
    print("every aggregate agrees" if wrong == 0 else f"{wrong} aggregates differ")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
