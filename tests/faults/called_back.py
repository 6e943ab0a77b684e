"""`sauna` as a script of a user's runs it: with a callback, which stops a member in the end.

    python -m faults.called_back ARGUMENTS

The callback decides by the row alone, so a run that is stopped and resumed decides the same. On the
device there is none: with one, each call of the program would be a single iteration.
"""

from __future__ import annotations

from typing import Any


def call_back() -> None:
    """Gives every training of this process the callback."""
    from sauna import api

    plain = api.train_and_draw

    def train_and_draw(run: Any, *given: Any, **named: Any) -> None:
        enough = 3 * run.config.steps // 4

        def callback(row: dict[str, Any]) -> bool:
            return row["seed"] == 1 and row["env_steps"] >= enough

        more = {} if run.config.backend == "device" else {"callback": callback}
        plain(run, *given, **named, **more)

    api.train_and_draw = train_and_draw


if __name__ == "__main__":
    from sauna.cli import main

    call_back()
    main()
