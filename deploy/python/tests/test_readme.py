"""What the package's page says can be done, done."""

import re
import subprocess
import sys

from conftest import REPOSITORY, rit

PAGE = (REPOSITORY / "deploy/python/README.md").read_text()


def snippets(section):
    """The Python of one section."""
    (text,) = re.findall(rf"^## {section}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def test_a_trained_policy(matrix_run, tmp_path, monkeypatch):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/matrix-game-1").symlink_to(matrix_run)
    monkeypatch.chdir(tmp_path)
    names = {}
    for code in snippets("A trained policy"):
        exec(compile(code, "README.md", "exec"), names)
    assert names["actions"].shape == (2,) and names["utilities"].shape == (2, 3) and names["tasks"].shape == (2, 32)


def test_your_own_environment(tmp_path, monkeypatch):
    """The page's module and experiment, and the commands that it gives, in a folder of their own."""
    module, use, _ = snippets("Your own environment")
    (experiment,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (commands,) = [block for block in re.findall(r"```\n(rit .*?)```", PAGE, re.DOTALL) if "gather" in block]
    (tmp_path / "my_worlds.py").write_text(module)
    (tmp_path / "gather.toml").write_text(experiment)
    monkeypatch.chdir(tmp_path)
    for command in commands.splitlines():
        arguments = command.split()[1:]
        # A page's worth of steps takes minutes of a busy machine; whether it learns is another test's.
        arguments = ["2k" if argument == "20k" else argument for argument in arguments]
        rit(*arguments)
    assert (tmp_path / "runs/gather-1/summary.json").exists() and (tmp_path / "curve.svg").exists()
    done = subprocess.run([sys.executable, "-c", use], capture_output=True, text=True, timeout=60)
    assert re.fullmatch(r"return -\d+\.0\n", done.stdout), done


def test_no_snippet_is_left_out():
    """Those that the tests above run, the adapter that test_mpe2 runs, and the wheel that `ci` builds and installs."""
    languages = re.findall(r"^```(\w*)$", PAGE, re.MULTILINE)[::2]
    assert sorted(languages) == ["", "", "python", "python", "python", "python", "toml"]
