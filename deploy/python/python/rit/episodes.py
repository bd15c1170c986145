"""Episodes that ``rit export --episodes`` has written, as arrays and as Minari datasets.

``deploy/docs/export.md`` has the format; the file needs no more than NumPy to be read.
"""

from __future__ import annotations

import json
import os
import re
import struct
from typing import Any

import numpy as np

#: What this package reads. It changes when a tensor changes its meaning.
FORMAT_VERSION = 1

TYPES = {"F32": "<f4", "I64": "<i8", "U8": "u1", "BOOL": "?"}


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """The file's description, and the arrays of each task by name."""
    with open(path, "rb") as file:
        try:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(length))
            description = json.loads(header.pop("__metadata__")["rit"])
            version = description["format_version"]
        except (struct.error, ValueError, KeyError, OverflowError, MemoryError) as error:
            raise ValueError(f"{os.fspath(path)} is no file of `rit export --episodes`: {error!r}") from None
        if version != FORMAT_VERSION:
            raise ValueError(f"{os.fspath(path)} has format version {version}, this package reads {FORMAT_VERSION}")
        numbers = file.read()
    tasks: dict[str, dict[str, np.ndarray]] = {task: {} for task in description["tasks"]}
    for name, entry in header.items():
        task, field = name.rsplit(".", 1)
        begin, end = entry["data_offsets"]
        values = np.frombuffer(numbers[begin:end], TYPES[entry["dtype"]])
        tasks[task][field] = values.reshape(entry["shape"])
    return description, tasks


def to_minari(path: str | os.PathLike[str], name: str, version: int = 0) -> list[str]:
    """Makes a Minari dataset of each task: ``NAME-TASK-vVERSION``, such as ``navigation/expert-navigation-2-2-v0``.

    They lie where Minari keeps its datasets (``MINARI_DATASETS_PATH``). Needs ``pip install 'minari[hdf5]'``. Returns their
    names.
    """
    import minari
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer

    description, tasks = read(path)
    made = []
    for task, arrays in tasks.items():
        n_agents, n_actions = arrays["available"].shape[1:]
        observed = {field: arrays[field] for field in ("features", "observable", "available")}
        observation_space = spaces.Dict(
            {
                "features": spaces.Box(-np.inf, np.inf, arrays["features"].shape[1:], np.float32),
                "observable": spaces.MultiBinary(arrays["observable"].shape[1:]),
                "available": spaces.MultiBinary(arrays["available"].shape[1:]),
            }
        )
        buffer, state, step = [], 0, 0
        for number, steps in enumerate(arrays["steps"]):
            over = np.arange(steps) == steps - 1
            terminated = bool(arrays["terminated"][number])
            buffer.append(
                EpisodeBuffer(
                    id=number,
                    observations={field: _flags(values[state : state + steps + 1]) for field, values in observed.items()},
                    actions=arrays["actions"][step : step + steps].astype(np.int64),
                    rewards=list(arrays["rewards"][step : step + steps].astype(float)),
                    terminations=list(over & terminated),
                    truncations=list(over & (not terminated)),
                    infos={"won": np.append(False, over & bool(arrays["won"][number]))},
                )
            )
            state, step = state + steps + 1, step + steps
        dataset = f"{name}-{re.sub(r'[^-_0-9A-Za-z]', '_', task)}-v{version}"
        minari.create_dataset_from_buffers(
            dataset,
            buffer,
            observation_space=observation_space,
            action_space=spaces.MultiDiscrete([n_actions] * n_agents),
            algorithm_name=description["policy"],
            description=f"{task} of {description['task_set']}: features {description['feature_names']}, "
            f"actions {description['action_names']}",
        )
        made.append(dataset)
    return made


def _flags(values: np.ndarray) -> np.ndarray:
    """Flags as the numbers that Gymnasium's spaces have."""
    return values.astype(np.int8) if values.dtype == bool else values
