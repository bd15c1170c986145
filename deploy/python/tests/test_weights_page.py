"""The page on weights: its script acts as the program does, and its table is the file's."""

import re

import numpy as np
import pytest
from conftest import REPOSITORY, train

import rit

PAGE = (REPOSITORY / "deploy/docs/weights.md").read_text()


@pytest.fixture(scope="module")
def script():
    """What the page's script defines."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names = {}
    exec(compile(code, "weights.md", "exec"), names)
    return names


@pytest.mark.parametrize(
    "method", ["rit", "rit-no-task-representations", "qmix-attn", "vdn-int", "refil", "refil beside"]
)
def test_the_script_acts_as_the_program_does(script, method, tmp_path):
    name, *encoder = method.split()
    run, _ = train(
        tmp_path,
        "predator-prey",
        *("--algorithm", name, "--steps", 400, "--seed", 5),
        *("--set", "network.hidden_dim=16", "--set", "network.attention_dim=16", "--set", "network.n_heads=2"),
        *("--set", "algorithm.batch_size=8", "--set", "evaluation.episodes=1"),
        *(argument for key in encoder for argument in ("--set", f"algorithm.encoder={key}")),
    )
    program = rit.Policy.load(run)
    alone = script["NumpyPolicy"](run / "checkpoints/latest/weights.safetensors")
    assert alone.description == program.description
    rng = np.random.default_rng(1)
    n, m, features, n_actions = 3, 6, len(program.feature_names), program.n_actions
    for _ in range(3):
        program.reset(n)
        alone.reset(n)
        reward = 0.0
        for _ in range(10):
            seen = rng.normal(size=(m, features)).astype(np.float32)
            observable = (rng.random((n, m)) < 0.6) | np.eye(n, m, dtype=bool)
            observable[0] = False  # it sees nothing, not even itself
            available = rng.random((n, n_actions)) < 0.7
            available[:, 2] = True
            expected = program.act(seen, observable, available, reward)
            found = alone.act(seen, observable.astype(int), available, reward)
            np.testing.assert_allclose(alone.utilities, program.utilities(), rtol=1e-4, atol=1e-5)
            assert (found == expected).all()
            if program.task_representations() is not None:
                np.testing.assert_allclose(
                    alone.task_representations, program.task_representations(), rtol=1e-4, atol=1e-5
                )
            reward = float(rng.normal())


def test_the_pages_keys_are_the_files(matrix_run):
    section, _ = PAGE.split("## Acting with NumPy alone")
    rows = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert sorted(rows) == sorted(rit.Policy.load(matrix_run).description)
