"""Recorded episodes as a Minari dataset, under `MINARI_DATASETS_PATH` or a folder of the user's."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sauna.envs.shapes import mask_in, one_of
from sauna.envs.spaces import Spaces, describe, observation_reader
from sauna.envs.wrapping import PLAIN, Wrapping
from sauna.system.errors import BadInput, one_line
from sauna.training.data.episodes import (
    MINARI,
    Add,
    Recorded,
    Stored,
    check_installed,
    check_same,
)
from sauna.training.data.masks import COLUMN, read_masks, with_every_action, with_masks

ROOT = "MINARI_DATASETS_PATH"


def _place(text: str) -> tuple[Path, str]:
    """The folder of datasets and the name in it: `NAME`, or a path whose last part is one."""
    name = text.removeprefix(MINARI)
    if name.startswith(("/", "./", "../", "~")):
        path = Path(name).expanduser()
        return Path.cwd() / path.parent, path.name
    from minari.storage.datasets_root_dir import get_dataset_path

    return Path.cwd() / get_dataset_path(), name


@contextmanager
def minari_writer(
    text: str, env: Any, about: Mapping[str, Any], wrapping: Wrapping = PLAIN
) -> Iterator[Add]:
    """A function that adds an episode to a new dataset, which is there at the end.

    Args:
      text: `minari:NAME`, such as `minari:cartpole/ppo-v0`, or `minari:./FOLDER/NAME`.
      env: whose spaces are read.
      about: JSON values that say how the episodes were played.
      wrapping: what is around it. With one that gives other observations, no description is
        stored: it would tell other spaces. Masks are infos.

    Raises:
      BadInput: the name is none, the dataset is there, or Minari is not.
    """
    check_installed("to: a Minari dataset", "minari", "minari", "h5py")
    from minari.dataset.minari_dataset import parse_dataset_id

    root, name = _place(text)
    try:
        namespace = parse_dataset_id(name)[0]
    except (TypeError, ValueError):
        raise BadInput(
            f"to: {name!r} is no name of a Minari dataset: [NAMESPACE/]NAME-vNUMBER"
        ) from None
    if (root / name).exists():
        raise BadInput(f"to: {root / name} is there already")
    root.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=".sauna-", dir=root))
    try:
        spec = _spec_of(env) if wrapping._replace(action_mask=False) == PLAIN else None
        yield _Writer(temporary, name, env, spec, about).add
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (temporary / name).rename(root / name)
        if namespace is not None:
            with _root(root):
                _know_namespace(namespace)
    finally:
        shutil.rmtree(temporary)


def _know_namespace(namespace: str) -> None:
    from minari.namespace import create_namespace, list_local_namespaces

    if namespace not in list_local_namespaces():
        create_namespace(namespace)


@contextmanager
def _root(path: Path) -> Iterator[None]:
    """Lets Minari, which reads a variable, write below `path`."""
    before = os.environ.get(ROOT)
    os.environ[ROOT] = str(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an author and a link to the code, which it misses
            yield
    finally:
        del os.environ[ROOT]
        if before is not None:
            os.environ[ROOT] = before


class _Writer:
    def __init__(
        self, root: Path, name: str, env: Any, spec: Any, about: Mapping[str, Any]
    ) -> None:
        self._root, self._name, self._env, self._about = root, name, env, about
        self._spec = spec
        self._dataset: Any = None

    def add(self, episode: Recorded) -> None:
        """Appends an episode: only one is in memory at a time."""
        import minari
        from minari.data_collector import EpisodeBuffer

        flags = np.zeros((2, len(episode.reward)), bool)
        flags[:, -1] = episode.terminated, episode.truncated
        buffer = EpisodeBuffer(
            seed=episode.seed,
            observations=episode.observation,
            actions=episode.action,
            rewards=episode.reward,
            terminations=flags[0],
            truncations=flags[1],
            infos=None if episode.mask is None else {COLUMN: episode.mask},
        )
        with _root(self._root):
            if self._dataset is None:
                self._dataset = minari.create_dataset_from_buffers(
                    self._name,
                    [buffer],
                    env=self._spec,
                    observation_space=mask_in(self._env.observation_space)[1],
                    action_space=self._env.action_space,
                    algorithm_name=f"SAUNA {self._about['version']}, {self._about['member']}",
                    description=json.dumps(self._about),
                    data_format="hdf5",
                    jpeg_encoding=False,
                )
            else:
                self._dataset.update_dataset_from_buffer([buffer])


def _spec_of(env: Any) -> Any:
    """Gymnasium's description of an environment; None if it has none that a file can hold."""
    spec: Any = getattr(env, "spec", None)
    try:
        spec.to_json()
    except (AttributeError, TypeError, ValueError):
        return None
    return spec


def read_minari(text: str, name: str, spaces: Spaces, env: str) -> Iterator[Stored]:
    """The episodes of a local dataset. Its environment is not made.

    Args:
      text: `minari:NAME`; name: what messages call it.

    Raises:
      BadInput: there is no such dataset, it cannot be read, or its spaces differ.
    """
    check_installed(name, "minari", "minari", "h5py")
    from minari.dataset.minari_dataset import MinariDataset
    from minari.dataset.minari_storage import MinariStorage

    root, own = _place(text)
    path = root / own / "data"
    try:
        metadata = MinariStorage.read_raw_metadata(path)
        if not {"observation_space", "action_space"} <= set(metadata):
            raise BadInput(f"{name} does not say its spaces: they would need its environment")
        dataset = MinariDataset(path)
        found = describe(dataset.observation_space, dataset.action_space)
        check_same(found, spaces, name, env)
        reader = observation_reader(dataset.observation_space)
        for episode in dataset.iterate_episodes():
            yield _stored(episode, dataset.observation_space, reader, spaces, name)
    except BadInput as error:
        raise BadInput(str(error) if name in str(error) else f"{name}: {error}") from error
    except (ImportError, OSError, ValueError, LookupError, TypeError, AssertionError) as error:
        raise BadInput(f"{name} cannot be read as a Minari dataset: {one_line(error)}") from error


def _stored(episode: Any, space: Any, reader: Any, spaces: Spaces, name: str) -> Stored:
    length = len(episode.rewards)
    rows = [reader(one_of(space, episode.observations, i)) for i in range(length + 1)]
    seen = np.stack(rows)
    ended = bool(len(episode.terminations) and episode.terminations[-1])
    masks = read_masks((episode.infos or {}).get(COLUMN), length, spaces, name)
    own, final = with_masks(seen[:-1], masks, spaces), with_every_action(seen[-1], spaces)
    return Stored(own, final, np.asarray(episode.actions), episode.rewards, ended)
