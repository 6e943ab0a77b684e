"""`sauna inspect`: one page about what a trained policy meets, and what the filter makes of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sauna.config.code import changed_code, code_of
from sauna.config.imported_from import names_the_folder
from sauna.config.own_sources import newer_sources
from sauna.config.parsing import what_is_played
from sauna.experiments.evaluate import MAX_STEPS
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.system.safe_write import replace_file
from sauna.system.working_folder import kept_folder
from sauna.training.artifact import find_member, load_artifact


@names_the_folder
@kept_folder()
def inspect(
    run: str | Path,
    *,
    member: str | int | None = None,
    episodes: int = 1,
    deterministic: bool = False,
    seed: int = 0,
    out: str | Path | None = None,
    frames: bool = True,
    max_steps: int = MAX_STEPS,
    trust: bool = False,
    say: Callable[[str], None] = print,
) -> Path:
    """Plays episodes with a member's policy and writes one self-contained page about them.

    The run's rule is asked as its code is today.

    Args:
      run: the run directory.
      member: name or index; default the first.
      episodes: played one after the other, with seeds `seed`, `seed + 1`, ...
      deterministic: the distribution's mode; otherwise actions are sampled, as in training.
      out: the page; default `RUN/inspect_MEMBER_MODE.html`.
      frames: draw the environment; where that fails, one line says so and the page has none.
      max_steps: env steps after which an episode that has not ended is cut.
      trust: the code that the run names may run, even if another user named it.
      say: receives a line for each checkpoint that cannot be trusted, for missing frames, and if
        today's code, which is asked, is not that of the run.

    Returns:
      the page.

    Raises:
      BadInput: no such run or member, impossible numbers, or a page that cannot be put there.
    """
    run = Path.cwd() / run  # an environment may go elsewhere
    episodes, seed, max_steps = what_is_played(episodes, seed, max_steps)
    stored = run_directory.read_config(run, needed=())  # an exported policy knows no training
    artifact = load_artifact(run, say, trust=trust)
    name = find_member(artifact.members, 0 if member is None else member)
    mode = "deterministic" if deterministic else "sampled"
    path = Path.cwd() / out if out else run / f"inspect_{name.replace('/', '-')}_{mode}.html"
    if path.is_dir() or not path.parent.is_dir():
        raise BadInput(f"out: {path} is a folder, or not in one")
    from sauna.experiments.inspect.inspection import examine  # imports JAX, so after the checks
    from sauna.experiments.inspect.page import make_page

    found = examine(run, artifact, name, episodes, deterministic, seed, frames, say, max_steps)
    before, now = stored.get("code", {}), code_of(stored)
    differs = (changed_code(before, now) or newer_sources(before, now)) if before else ""
    if differs:
        say(f"warning: the rule is asked with today's code, the run had other code: {differs}")
    replace_file(path, make_page(found, run).encode())
    return path
