"""Whose code a stored run or study names: this user's, or somebody else's.

A config may name code as `module:name`, which whoever opens the run executes. What this user
started carries a seal: the names, and a keyed hash of them (HMAC-SHA256) that only this user's key
can make. The key is in `SAUNA_KEY_FILE`, by default `~/.config/sauna/key`, readable by nobody else.
Names without the right seal are shown and refused, until the user says that they are trusted.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from sauna.config.plugins import is_local
from sauna.config.settings import fields_with
from sauna.system.errors import BadInput, SaunaError
from sauna.system.safe_read import read_file
from sauna.system.safe_write import open_new, sync_folder

FIELDS = (*fields_with("plugin"), "tasks", "measure", "track", "wrap")  # that may name code
OWN_WRAPPERS = ("sauna.envs.small_grey:SmallGrey", "sauna.envs.car_racing:EveryEighth")
# Ids of Gymnasium whose arguments name an environment of another library.
WRAPPERS = ("GymV21Environment", "GymV26Environment")
KEY_BYTES = 32


def named_code(stored: Any) -> list[list[str]]:
    """`[field, "module:name"]` for all code that JSON values name, sorted, each once.

    Parts that were passed by value are not among them: only the process that holds them can use
    them.
    """
    return sorted(map(list, set(_named(stored, ""))))


def _named(value: Any, field: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _named(part, str(key))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _named(part, field)
    elif isinstance(value, str) and field in FIELDS:
        is_ours = field == "wrap" and value in OWN_WRAPPERS
        names = ":" in value and not is_local(value) and not is_ours
        if names or any(wrapper in value for wrapper in WRAPPERS):
            yield ("env" if field == "tasks" else field), value


def arguments_of(stored: Any) -> list[str]:
    """All keyword arguments of environments among JSON values, as sorted JSON, each once."""
    return sorted(set(_arguments(stored)))


def _arguments(value: Any) -> Iterator[str]:
    if isinstance(value, list | tuple):
        for part in value:
            yield from _arguments(part)
    if not isinstance(value, Mapping):
        return
    for key, part in value.items():
        if key != "env_kwargs":
            yield from _arguments(part)
            continue
        try:
            part = json.loads(part) if isinstance(part, str) else part
        except ValueError:
            pass  # it is refused when it is read
        if part:
            yield json.dumps(part, sort_keys=True)


def seal(stored: Mapping[str, Any]) -> dict[str, Any]:
    """The seal of what is about to be stored: that this user named its code."""
    named = {"code": named_code(stored), "env_kwargs": arguments_of(stored)}
    return {**named, "mac": _mac(_key(), named)}


def check_trusted(stored: Mapping[str, Any], what: str, sealed: Any, trust: bool) -> None:
    """Refuses code that this user has not named.

    Args:
      stored: what names it: a config, a manifest, a study.
      what: its place, for the message.
      sealed: the seal that it carries, if any.
      trust: the user has said that it may run.

    Raises:
      BadInput: with everything that is named.
    """
    code = named_code(stored)
    if not code or trust or (_is_ours(sealed) and _covers(sealed, stored)):
        return
    listed = ", ".join(f"{field} {name!r}" for field, name in code)
    raise BadInput(
        f"{what} names code that would run, and is not known to be yours: {listed}; if you trust "
        f"it, give --trust (in Python trust=True)"
    )


def covers(mine: Mapping[str, Any], stored: Mapping[str, Any]) -> bool:
    """Whether all that `stored` would run is what the user named in `mine`."""
    return _covers({"code": named_code(mine), "env_kwargs": arguments_of(mine)}, stored)


def _covers(sealed: Mapping[str, Any], stored: Mapping[str, Any]) -> bool:
    names = all(name in sealed["code"] for name in named_code(stored))
    return names and all(text in sealed["env_kwargs"] for text in arguments_of(stored))


def _is_ours(sealed: Any) -> bool:
    if not isinstance(sealed, Mapping) or not isinstance(sealed.get("mac"), str):
        return False
    named = {name: sealed.get(name) for name in ("code", "env_kwargs")}
    if not all(isinstance(part, list) for part in named.values()):
        return False
    return hmac.compare_digest(sealed["mac"].encode(), _mac(_key(), named).encode())


def _mac(key: bytes, named: Mapping[str, Any]) -> str:
    text = json.dumps(named, sort_keys=True).encode()
    return hmac.new(key, b"sauna run 1\0" + text, hashlib.sha256).hexdigest()


def key_file() -> Path:
    """Where this user's key is kept."""
    chosen = os.environ.get("SAUNA_KEY_FILE")
    base = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    return Path(chosen) if chosen else Path(base) / "sauna" / "key"


def _key() -> bytes:
    """This user's key, made at its first use; where none can be kept, one of this process.

    Raises:
      BadInput: others can read the key, or it is none.
    """
    path = Path(os.path.realpath(key_file()))
    try:
        if not path.exists():
            _make_key(path)
    except OSError:
        return _passing_key()
    try:
        key = bytes.fromhex(read_file(path, 1024).decode().strip())
    except (SaunaError, ValueError) as error:
        raise BadInput(f"{path} cannot be read as a key: {error}") from error
    if path.stat().st_mode & 0o077:
        raise BadInput(f"{path} can be read by others: chmod 600 {path}")
    if len(key) < KEY_BYTES:
        raise BadInput(f"{path} is not a key of {KEY_BYTES} bytes")
    return key


def _make_key(path: Path) -> None:
    """Makes a key whole or not at all: of two processes, both end with the same."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.writing")
    with open_new(temporary) as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(secrets.token_hex(KEY_BYTES).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    finally:
        temporary.unlink()
    sync_folder(path.parent)


@cache
def _passing_key() -> bytes:
    return secrets.token_bytes(KEY_BYTES)
