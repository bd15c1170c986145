"""Copies a run's newest checkpoints to an object store, and fetches one back to go on with.

``python -m rit.copy --run DIR --to s3://BUCKET/PREFIX`` follows a live run until that has ended, or copies a finished one.
``python -m rit.copy --from s3://BUCKET/PREFIX --run DIR`` fetches the newest copy that is whole (``--at STEPS``: that one) into a
new folder; ``rit train --resume DIR`` then goes on as if the run had never stopped. ``file:///…`` works too, and what else the
package obstore knows (``pip install obstore``), with its usual settings: ``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, …

It only reads the run directory, so whatever becomes of the store, training goes on. What is uploaded is named by its SHA-256, so what
has not changed since the last checkpoint is not sent again; a checkpoint's list of files is uploaded after all of them, so one
that was cut off half-way does not count. Tokens, sockets and logs stay where they are.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import secrets
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rit._command import Failed, run_command, say, warn

FORMAT_VERSION = 1
#: Where lists of files, and files, lie below the prefix.
LISTS, FILES = "checkpoints", "files"
#: A checkpoint's name: its steps, and which one at that step it is where it is not the first.
NAME = r"step-([0-9]{12})(?:-([0-9]{1,9}))?"
STEP = re.compile(NAME)
LIST = re.compile(NAME + r"\.json")
#: What a copy may hold; lists come from outside, so nothing else is written.
ALLOWED = re.compile(
    r"config\.toml|run_id|place|lineage|metrics\.jsonl|summary\.json|initial\.safetensors"
    rf"|checkpoints/{NAME}/[A-Za-z0-9_]+(\.[a-z]+)?|replay/[0-9]{{12}}\.frames"
)
DIGEST = re.compile(r"[0-9a-f]{64}")
#: No list is longer, and no file.
LIST_MAX, FILE_MAX = 1 << 24, 1 << 36
FIRST_WAIT_S, WAIT_MAX_S = 0.5, 30.0


class Passing(Exception):
    """What may be done later: the store is away, or a file is gone by now."""


class Store:
    """A place for objects below a prefix."""

    def __init__(self, url: str) -> None:
        try:
            import obstore
            from obstore.store import from_url
        except ImportError:
            raise Failed("the package obstore is not installed: pip install obstore") from None
        self.url, self._obstore = url, obstore
        options: dict[str, Any] = {"retry_config": {"max_retries": 0}} if url.startswith("s3:") else {}
        endpoint = os.environ.get("AWS_ENDPOINT_URL", "") + os.environ.get("AWS_ENDPOINT", "")
        if url.startswith("s3:") and endpoint.startswith("http:"):
            options["client_options"] = {"allow_http": True}
        if url.startswith("file://"):
            Path(url.removeprefix("file://")).mkdir(parents=True, exist_ok=True)
        try:
            self._store = from_url(url, **options)
        except (obstore.exceptions.BaseError, ValueError, OSError) as error:
            raise Failed(f"{url}: {_line(error)}") from None

    def put(self, name: str, content: bytes) -> None:
        self._try(name, lambda: self._obstore.put(self._store, name, content))

    def get(self, name: str, size_max: int) -> bytes:
        def whole() -> bytes:
            found = self._obstore.get(self._store, name)
            if found.meta["size"] > size_max:
                raise Failed(f"{self.url}/{name} has {found.meta['size']} bytes where at most {size_max} should be")
            return bytes(found.bytes())

        return self._try(name, whole)

    def names(self, folder: str) -> set[str]:
        pages = self._try(folder, lambda: list(self._obstore.list(self._store, prefix=folder)))
        return {entry["path"].rpartition("/")[2] for page in pages for entry in page}

    def delete(self, name: str) -> None:
        self._try(name, lambda: self._obstore.delete(self._store, name))

    def _try(self, name: str, act: Any) -> Any:
        try:
            return act()
        except (self._obstore.exceptions.BaseError, OSError) as error:
            raise Passing(f"{self.url}/{name}: {_line(error)}") from None


class Copier:
    """Copies one run's checkpoints, the newest of those that there are."""

    def __init__(self, run: Path, store: Store, keep: int) -> None:
        self.run, self.store, self.keep = run, store, keep
        self.run_id = (run / "run_id").read_text().strip()
        self.lists = {name for name in store.names(LISTS) if LIST.fullmatch(name)}
        self.there = store.names(FILES)
        if self.lists:
            theirs = _listed(store, max(self.lists, key=_age)).run_id
            if theirs != self.run_id:
                raise Failed(f"{store.url} holds copies of another run ({theirs}); choose another prefix")

    def newest(self) -> str | None:
        """The newest checkpoint's name."""
        try:
            name = os.readlink(self.run / "checkpoints" / "latest")
        except FileNotFoundError:
            return None
        if not STEP.fullmatch(name):
            raise Failed(f"{self.run}/checkpoints/latest leads to {name!r}; this package knows names such as step-000000000400")
        return name

    def copy(self, step: str, summary: bool) -> int:
        """Uploads what has changed, then the list; the number of bytes."""
        sent, files = 0, []
        for name in self._names(step, summary):
            content = self._read(name)
            digest = hashlib.sha256(content).hexdigest()
            if digest not in self.there:
                self.store.put(f"{FILES}/{digest}", content)
                self.there.add(digest)
                sent += len(content)
            files.append({"path": name, "bytes": len(content), "sha256": digest})
        listed = {"format_version": FORMAT_VERSION, "run_id": self.run_id, "checkpoint": step, "files": files}
        self.store.put(f"{LISTS}/{step}.json", json.dumps(listed, indent=1).encode())
        self.lists.add(f"{step}.json")
        self._tidy()
        return sent

    def _names(self, step: str, summary: bool) -> Iterator[str]:
        # What grows comes last: it then holds at least what the checkpoint needs, and what is beyond is cut off.
        for path in sorted((self.run / "checkpoints" / step).iterdir()):
            yield f"checkpoints/{step}/{path.name}"
        for name in ("config.toml", "run_id", "place", "lineage", "initial.safetensors"):
            if (self.run / name).exists():
                yield name
        for path in sorted((self.run / "replay").glob("*.frames")):
            yield f"replay/{path.name}"
        yield "metrics.jsonl"
        if summary:
            yield "summary.json"

    def _read(self, name: str) -> bytes:
        try:
            return (self.run / name).read_bytes()
        except FileNotFoundError:
            raise Passing(f"{self.run / name} is gone: a newer checkpoint is there") from None

    def _tidy(self) -> None:
        """Removes copies beyond those that are kept, lists first, and what no list names."""
        lists = sorted(self.lists, key=_age)
        for name in lists[: -self.keep]:
            self.store.delete(f"{LISTS}/{name}")
            self.lists.discard(name)
        wanted: set[str] = set()
        for name in self.lists:
            wanted |= {digest for _, _, digest in _listed(self.store, name).files}
        for digest in self.there - wanted:
            self.store.delete(f"{FILES}/{digest}")
            self.there.discard(digest)


class Listed(NamedTuple):
    """What a copy's list says."""

    run_id: str
    checkpoint: str
    format_version: int
    #: Place in the run directory, bytes, SHA-256.
    files: list[tuple[str, int, str]]


def _age(name: str) -> tuple[int, int]:
    """What the names of lists are sorted by, oldest first: steps, and which one at that step."""
    steps, repetition = LIST.fullmatch(name).groups()
    return int(steps), int(repetition or 1)


def _listed(store: Store, name: str) -> Listed:
    text = store.get(f"{LISTS}/{name}", LIST_MAX)
    try:
        said = json.loads(text)
        files = [(file["path"], int(file["bytes"]), file["sha256"]) for file in said["files"]]
        return Listed(said["run_id"], said["checkpoint"], said["format_version"], files)
    except (ValueError, KeyError, TypeError) as error:
        raise Failed(f"{store.url}/{LISTS}/{name} cannot be read ({error!r})") from None


class Patience:
    """Tries again, less and less often, until it is not worth it."""

    def __init__(self, patience_s: float) -> None:
        self.deadline, self.wait_s = time.monotonic() + patience_s, FIRST_WAIT_S

    def waits(self) -> bool:
        if time.monotonic() + self.wait_s > self.deadline:
            return False
        time.sleep(self.wait_s)
        self.wait_s = min(2 * self.wait_s, WAIT_MAX_S)
        return True


def follow(run: Path, url: str, keep: int, once: bool, every_s: float, patience_s: float) -> int:
    """Copies checkpoint after checkpoint until the run has ended, or what is there now. The number of failures."""
    store, copier, done, failures = Store(url), None, None, 0
    patience: Patience | None = None
    while True:
        if not run.is_dir():
            raise Failed(f"{run} is gone")
        # Looked for first: the last checkpoint was written before it.
        ended = (run / "summary.json").exists()
        try:
            copier = copier or Copier(run, store, keep)
            step = copier.newest()
            if step is not None and (step, ended) != done:
                sent = copier.copy(step, ended)
                say(f"{step} copied, {sent} bytes sent")
                done = (step, ended)
            patience = None
        except Passing as error:
            patience = patience or Patience(patience_s)
            if patience.waits():
                continue
            failures += 1
            warn(f"warning: not copied ({failures} so far): {error}")
            patience = None
            if ended or once:
                raise Failed("the newest checkpoint was not copied") from None
        if ended or once:
            if done is None:
                raise Failed(f"{run} has no checkpoint")
            return failures
        time.sleep(every_s)


def fetch(url: str, run: Path, at: int | None, patience_s: float) -> str:
    """Fetches the newest copy that is whole into a new folder; its checkpoint's name."""
    store = Store(url)
    names = [name for name in _again(patience_s, lambda: store.names(LISTS)) if LIST.fullmatch(name)]
    names.sort(key=_age, reverse=True)
    if at is not None:
        names = [name for name in names if _age(name)[0] == at]
    for name in names:
        try:
            return _fetch(store, name, run, patience_s)
        except Failed as error:
            warn(f"warning: {error}; the one before is tried")
    raise Failed(f"{url} holds no {'copy that is whole' if names else 'copy' if at is None else f'copy of step {at}'}")


def _fetch(store: Store, name: str, run: Path, patience_s: float) -> str:
    run_id, step, version, files = _again(patience_s, lambda: _listed(store, name))
    if version != FORMAT_VERSION or f"{step}.json" != name:
        raise Failed(f"{store.url}/{LISTS}/{name}: format {version} of {step}; this package knows format {FORMAT_VERSION}")
    for path, size, digest in files:
        if not (ALLOWED.fullmatch(path) and DIGEST.fullmatch(digest) and 0 <= size <= FILE_MAX):
            raise Failed(f"{store.url}/{LISTS}/{name} names {path!r}, which no copy holds")
    folder = Path(tempfile.mkdtemp(dir=run.parent, prefix=f".{run.name}."))
    try:
        for path, size, digest in files:
            content = _again(patience_s, lambda: store.get(f"{FILES}/{digest}", size))
            if len(content) != size or hashlib.sha256(content).hexdigest() != digest:
                raise Failed(f"{store.url}/{FILES}/{digest} ({path} of {step}) was altered")
            _write(folder / path, content)
        os.symlink(step, folder / "checkpoints" / "latest")
        known = {"format_version": 1, "run_id": run_id, "newest": step}
        _write(folder / "checkpoints.json", json.dumps(known, indent=2).encode())
        # The run's own was not copied: it opens doors.
        _write(folder / "token", f"{secrets.token_hex(16)}\n".encode())
        os.rename(folder, run)
    except BaseException:
        _remove(folder)
        raise
    return step


def _again(patience_s: float, act: Any) -> Any:
    patience = Patience(patience_s)
    while True:
        try:
            return act()
        except Passing as error:
            if not patience.waits():
                raise Failed(str(error)) from None


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _remove(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        path.unlink() if path.is_symlink() or not path.is_dir() else path.rmdir()
    folder.rmdir()


def _line(error: BaseException) -> str:
    """The first line: what follows there is for who debugs the store."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:500]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m rit.copy", description=__doc__.split("\n\n")[0])
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="run directory: of a live or finished run, or, with --from, a new one")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--to", metavar="URL", help="copy there: s3://BUCKET/PREFIX or file:///FOLDER")
    where.add_argument("--from", dest="source", metavar="URL", help="fetch from there")
    parser.add_argument("--at", type=int, metavar="STEPS", help="with --from: the checkpoint after so many steps; without, the newest")
    parser.add_argument("--keep", type=int, default=3, metavar="N", help="copies that are kept, the newest")
    parser.add_argument("--once", action="store_true", help="copy what is there now, and do not follow")
    parser.add_argument("--every", type=float, default=5.0, metavar="S", help="seconds between two looks at the run")
    parser.add_argument("--patience", type=float, default=600.0, metavar="S", help="seconds that a store may be away")
    options = parser.parse_args(arguments)
    if options.keep < 1:
        parser.error(f"--keep {options.keep}: at least 1")
    if options.source is not None and options.run.exists():
        parser.error(f"--run {options.run} is there already; name a new folder")
    if options.source is None and not options.run.is_dir():
        parser.error(f"--run {options.run}: there is no such folder")

    def copy() -> None:
        if options.source is None:
            follow(options.run, options.to, options.keep, options.once, max(options.every, 0.1), options.patience)
        else:
            step = fetch(options.source, options.run, options.at, options.patience)
            say(f"{step} fetched; `rit train --resume {options.run}` goes on")

    return run_command(copy)


if __name__ == "__main__":
    sys.exit(main())
