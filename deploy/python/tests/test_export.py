"""What `rit export` writes does elsewhere what the program does here: the scripts of the page on it, run."""

import json
import re

import numpy as np
import pytest
from conftest import REPOSITORY, train
from conftest import rit as program

import rit
import rit.episodes

PAGE = (REPOSITORY / "deploy/docs/export.md").read_text()
METHODS = ["rit", "rit-no-task-representations", "qmix-attn", "vdn-int", "refil", "refil beside"]


def script(section):
    """What the script of a section of the page defines."""
    (text,) = re.findall(rf"^## {section}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}
    exec(compile(code, "export.md", "exec"), names)
    return names


@pytest.fixture(scope="module", params=METHODS)
def trained(request, tmp_path_factory):
    """A short run of small networks."""
    name, *encoder = request.param.split()
    run, _ = train(
        tmp_path_factory.mktemp("trained"),
        "predator-prey",
        *("--algorithm", name, "--steps", 400, "--seed", 5),
        *("--set", "network.hidden_dim=16", "--set", "network.attention_dim=16", "--set", "network.n_heads=2"),
        *("--set", "algorithm.batch_size=8", "--set", "evaluation.episodes=1"),
        *(argument for key in encoder for argument in ("--set", f"algorithm.encoder={key}")),
    )
    return run


def episodes(policy):
    """Random states of teams of several sizes, what the program's own policy makes of them, and that policy."""
    rng = np.random.default_rng(1)
    for n, m in [(3, 6), (1, 1), (5, 9)]:
        policy.reset(n)
        reward = 0.0
        for step in range(6):
            seen = rng.normal(size=(m, len(policy.feature_names))).astype(np.float32)
            observable = (rng.random((n, m)) < 0.6) | np.eye(n, m, dtype=bool)
            observable[0] = False  # it sees nothing, not even itself
            available = rng.random((n, policy.n_actions)) < 0.7
            available[:, 2] = True
            actions = policy.act(seen, observable, available, reward)
            yield (n if step == 0 else None), (seen, observable, available, reward), actions
            reward = float(rng.normal())


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_onnx_acts_as_the_program_does(trained, tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    said = json.loads(program("export", "--run", trained, "--onnx", tmp_path / "policy", "--json").stdout)
    policy = rit.Policy.load(trained)
    assert (said["opset"], said["weights_digest"]) == (17, policy.description["digest"])
    for file in said["files"]:
        model = onnx.load(file)
        onnx.checker.check_model(model, full_check=True)
        (description,) = (one.value for one in model.metadata_props)
        assert json.loads(description) == policy.description
    elsewhere = script("ONNX")["OnnxPolicy"](tmp_path / "policy")
    for n_agents, given, actions in episodes(policy):
        if n_agents:
            elsewhere.reset(n_agents)
        assert (elsewhere.act(*given) == actions).all()
        close(elsewhere.utilities, policy.utilities())
        if policy.task_representations() is not None:
            close(elsewhere.task_representations, policy.task_representations())
    again = program("export", "--run", trained, "--onnx", tmp_path / "policy", check=False)
    assert again.returncode == 2 and "encoder.onnx is there already; --force writes over it" in again.stderr


def test_torch_has_the_programs_utilities(trained):
    torch = pytest.importorskip("torch")
    policy = rit.Policy.load(trained)
    elsewhere = script("PyTorch")["TorchPolicy"](trained / "checkpoints/latest/weights.safetensors")
    memory, one_hots = None, np.eye(policy.n_actions)
    for n_agents, (seen, observable, _, reward), actions in episodes(policy):
        last = np.zeros((len(seen), policy.n_actions))
        if n_agents:
            memory = None
        else:
            last[: len(before)] = one_hots[before]
        entities = torch.tensor(np.hstack([seen, last]).tolist())
        given = [torch.tensor(values.tolist()) for values in (observable, actions)]
        utilities, z, memory = elsewhere(entities, given[0], given[1], reward, memory)
        close(utilities.tolist(), policy.utilities())
        if policy.task_representations() is not None:
            close(z.tolist(), policy.task_representations())
        before = actions
    utilities.sum().backward()
    assert elsewhere.get("utility.head.weight").grad.abs().sum() > 0


def test_other_methods_and_half_a_command_are_refused(tmp_path):
    run, _ = train(tmp_path, "matrix-game", "--algorithm", "updet-vdn", "--steps", 200, "--set", "evaluation.episodes=1")
    refused = program("export", "--run", run, "--onnx", tmp_path / "policy", check=False)
    assert refused.returncode == 2 and not (tmp_path / "policy").exists()
    assert "updet-vdn cannot be exported to ONNX; these can: rit, rit-vdn," in refused.stderr
    for arguments in [("--run", run), ("--run", run, "--episodes", 1), ("--run", run, "--onnx", "a", "--episodes", 1)]:
        assert program("export", *arguments, check=False).returncode == 2


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Five episodes of each training task by a script, and what was said of them."""
    file = tmp_path_factory.mktemp("episodes") / "random.safetensors"
    arguments = ("--policy", "script:random", "--experiment", "predator-prey", "--episodes", 5, "--seed", 7)
    return file, json.loads(program("export", *arguments, "--out", file, "--json").stdout)


def test_episodes_are_those_that_evaluation_measures(exported):
    file, said = exported
    arguments = ("--policy", "script:random", "--experiment", "predator-prey", "--episodes", 5, "--seed", 7, "--json")
    measured = json.loads(program("evaluate", *arguments).stdout)["tasks"]
    description, tasks = rit.episodes.read(file)
    assert list(tasks) == description["tasks"] == [task["task"] for task in said["tasks"]] == list(measured)
    for task, arrays in tasks.items():
        ends = np.cumsum(arrays["steps"])
        returns = [part.sum() for part in np.split(arrays["rewards"], ends[:-1])]
        np.testing.assert_allclose(returns, np.broadcast_to(measured[task]["returns"], 5), rtol=1e-5)
        states = len(arrays["rewards"]) + 5
        assert arrays["features"].shape[0] == arrays["observable"].shape[0] == arrays["available"].shape[0] == states
        assert arrays["features"].shape[2] == len(description["feature_names"]) == 7
        kinds = arrays["features"][:, :, 4:].argmax(axis=2)  # agents, landmarks, prey
        assert (np.diff(kinds, axis=1) >= 0).all(), "agents come first"


def test_minari_loads_them(exported, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    file, _ = exported
    description, tasks = rit.episodes.read(file)
    names = rit.episodes.to_minari(file, "hunt/random")
    assert names[0] == "hunt/random-predator-prey-2-1-v0"
    for name, (task, arrays) in zip(names, tasks.items(), strict=True):
        dataset = minari.load_dataset(name)
        assert (dataset.total_episodes, dataset.total_steps) == (5, arrays["steps"].sum())
        state = step = 0
        for episode in dataset.iterate_episodes():
            steps = len(episode.rewards)
            for field in ("features", "observable", "available"):
                assert (episode.observations[field] == arrays[field][state : state + steps + 1]).all(), field
                assert dataset.observation_space[field].contains(episode.observations[field][0])
            assert (episode.actions == arrays["actions"][step : step + steps]).all()
            assert dataset.action_space.contains(episode.actions[0])
            np.testing.assert_allclose(episode.rewards, arrays["rewards"][step : step + steps])
            ends = episode.terminations | episode.truncations
            assert ends[-1] and not ends[:-1].any()
            state, step = state + steps + 1, step + steps


def test_other_files_are_no_episodes(tmp_path, exported):
    torn = tmp_path / "torn.safetensors"
    for length in (0, 7, 20):
        torn.write_bytes(exported[0].read_bytes()[:length])
        with pytest.raises(ValueError, match="is no file of `rit export --episodes`"):
            rit.episodes.read(torn)
