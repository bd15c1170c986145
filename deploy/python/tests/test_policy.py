"""A trained policy in Python is the one that `rit evaluate` measures."""

import json
import subprocess
import sys

import numpy as np
import pytest
from conftest import rit

import rit as package

FIRST_REWARD = [-12.0, -6.0, 0.0, 6.0]
OPTIMAL = [(0, 2), (2, 2), (0, 1), (0, 0)]


def look(step):
    """What both players of a matrix game see: who they are, and which step it is."""
    return np.array([[1, 0, step], [0, 1, step]])


def play(policy, game):
    """The return of one matrix game."""
    policy.reset(2)
    policy.act(look(0))
    second = policy.act(look(1), previous_reward=FIRST_REWARD[game])
    return FIRST_REWARD[game] + (100.0 if tuple(second) == OPTIMAL[game] else -12.0)


def test_it_reaches_what_evaluation_measures(matrix_run):
    policy = package.Policy.load(matrix_run)
    measured = json.loads(rit("evaluate", "--run", matrix_run, "--episodes", 1, "--json").stdout)
    returns = {f"game-{game + 1}": play(policy, game) for game in range(4)}
    assert returns == {task: result["mean_return"] for task, result in measured["tasks"].items()}
    assert policy.description["digest"] == measured["weights_digest"]


def test_it_says_what_it_is(matrix_run):
    policy = package.Policy.load(matrix_run)
    assert (policy.method, policy.description["task_set"]) == ("rit", "matrix-game")
    assert policy.feature_names == ["player.0", "player.1", "step"]
    assert policy.action_names == ["a1", "a2", "a3"]
    assert policy.n_actions == 3


def test_every_way_to_name_weights(matrix_run):
    newest = package.Policy.load(str(matrix_run)).description["digest"]
    assert package.Policy.load(matrix_run / "checkpoints/latest/weights.safetensors").description["digest"] == newest
    assert package.Policy.load(matrix_run / "checkpoints/latest").description["digest"] == newest
    assert package.Policy.load(f"{matrix_run}@200").description["digest"] != newest


def test_many_environments_at_once_are_the_same_to_the_bit(matrix_run):
    alone, many = (package.Policy.load(matrix_run) for _ in range(2))
    many.reset([2, 2, 2])
    rewards = [0.0, 0.0, 0.0]
    seen = [[], [], []]
    for step, acting in enumerate([[0, 1, 2], [0, 2], [0, 1, 2]]):
        given = [look(step) if environment in acting else None for environment in range(3)]
        actions = many.act(given, previous_reward=rewards)
        assert [one is None for one in actions] == [environment not in acting for environment in range(3)]
        for environment in acting:
            seen[environment].append((step, rewards[environment], actions[environment], many.utilities(environment)))
        rewards = [6.0, -12.0, 0.5]
    for steps in seen:
        alone.reset(2)
        for step, reward, actions, utilities in steps:
            assert (alone.act(look(step), previous_reward=reward) == actions).all()
            assert alone.utilities().tobytes() == utilities.tobytes()
    many.reset_one(1, 2)
    with pytest.raises(package.ActError, match="there is no environment 3"):
        many.reset_one(3, 2)


def test_what_actions_are_chosen_by_can_be_read(matrix_run):
    policy = package.Policy.load(matrix_run)
    policy.reset(2)
    actions = policy.act(look(0), available=[[1, 1, 1], [1, 1, 1]])
    utilities = policy.utilities()
    assert utilities.shape == (2, 3) and (utilities.argmax(axis=1) == actions).all()
    assert policy.task_representations().shape == (2, 32)
    best = actions[0]
    policy.reset(2)
    available = np.ones((2, 3))
    available[0, best] = 0
    assert policy.act(look(0), available=available)[0] != best


def test_the_decision_order_matters_and_agents_keep_their_rows(matrix_run):
    policy = package.Policy.load(matrix_run)
    utilities = {}
    for order in [(0, 1), (1, 0)]:
        policy.reset(2, order=order)
        policy.act(look(0))
        utilities[order] = policy.utilities()
    assert not np.array_equal(utilities[0, 1], utilities[1, 0])
    policy.reset(2, order=[1, 0])
    swapped = look(0)[::-1]
    policy.act(swapped)
    # The same players decide in the same order: the rows are swapped, and nothing else.
    np.testing.assert_array_equal(policy.utilities()[::-1], utilities[0, 1])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"entities": np.zeros((2, 4))}, r"entities are \(2, 4\), not \(n_entities, 3\)"),
        ({"entities": np.full((2, 3), np.nan)}, "feature 0 of entity 0 is NaN; features are finite numbers"),
        ({"entities": np.zeros((1, 3))}, "2 agents of 1 entities; agents are entities too"),
        ({"available": [[0, 0, 0], [1, 1, 1]]}, "agent 0 has no available action"),
        ({"available": [[2, 0, 0], [1, 1, 1]]}, "available must be 0 or 1 everywhere"),
        ({"observable": [[1, 1]]}, r"observable is \(1, 2\), not \(2, 2\)"),
        ({"observable": [[0, 1], [1, 1]]}, "agent 0 sees others and not itself"),
        ({"previous_reward": np.inf}, "previous_reward is inf; it must be a finite number"),
    ],
)
def test_what_it_cannot_act_in_is_named(matrix_run, given, words):
    policy = package.Policy.load(matrix_run)
    policy.reset(2)
    with pytest.raises(package.ActError, match=words):
        policy.act(**{"entities": look(0), **given})


def test_an_episode_is_begun_first(matrix_run):
    policy = package.Policy.load(matrix_run)
    with pytest.raises(package.ActError, match="no episode has begun"):
        policy.act(look(0))
    with pytest.raises(package.ActError, match="the decision order must have each of 0 to 1 once"):
        policy.reset(2, order=[0, 0])
    with pytest.raises(package.ActError, match="0 agents; this policy takes 1 to 255"):
        policy.reset(0)


def test_errors_have_the_programs_words(matrix_run, tmp_path):
    with pytest.raises(package.WeightsError, match="has no checkpoint 7; it has latest, step-"):
        package.Policy.load(f"{matrix_run}@7")
    refused = rit("train", "matrix-game", "--run-dir", tmp_path / "run", "--from", f"{matrix_run}@7", check=False)
    with pytest.raises(package.RitError) as raised:
        package.Policy.load(f"{matrix_run}@7")
    assert refused.returncode == 2 and str(raised.value) in refused.stderr
    with pytest.raises(ValueError, match="there is no such file or folder"):
        package.Policy.load(tmp_path / "nothing")
    (tmp_path / "torn").write_bytes(b"\x00" * 20)
    with pytest.raises(package.WeightsError, match="no whole safetensors file"):
        package.Policy.load(tmp_path / "torn")


THREADS = """
import faulthandler, sys, threading
import numpy as np, rit
faulthandler.dump_traceback_later(60, exit=True)
policy = rit.Policy.load(sys.argv[1])
environments = 64
policy.reset([2] * environments)
seen = [np.array([[1, 0, 0], [0, 1, 0]])] * environments
done = threading.Event()

def read():
    while not done.is_set():
        policy.utilities()

policy.act(seen)
reader = threading.Thread(target=read)
reader.start()
for _ in range(200):
    policy.act(seen)
done.set()
reader.join()
"""


def test_a_thread_that_acts_and_one_that_reads_do_not_wait_for_each_other(matrix_run):
    # A process of its own, which its watchdog ends: two threads that wait for each other would stop the tests too.
    done = subprocess.run([sys.executable, "-c", THREADS, matrix_run], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
