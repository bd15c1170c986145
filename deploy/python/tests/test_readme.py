"""What the package's page says can be done, done."""

import re

from conftest import REPOSITORY

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
