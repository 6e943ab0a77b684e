"""The model card of an exported policy: `README.md`, with front matter for the Hugging Face Hub."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.config.presets import overrides_of
from sauna.config.stored import read_stored
from sauna.experiments.study.results import typed
from sauna.system.errors import SaunaError, printable

PLACE = "THIS_FOLDER"
NAMED = re.compile(r'(?<=sauna eval )\S+|(?<=sauna.load\(")[^"]*')  # in the card
TEXT = """---
{front}
---

# {algorithm} on {env}

A policy that SAUNA trained for {steps} env steps: member `{member}`{best}.

{returns}

## Play it

```bash
pip install sauna-rl
sauna eval {place} --deterministic --episodes 20
```

```python
import gymnasium
import sauna

policy = sauna.load("{place}")
action = policy(observation)  # the most likely action for a raw observation
```

`policy.safetensors` holds the weights and the normaliser, `policy.json` the settings and spaces.
{forms}

## The environment

| | |
|---|---|
| Environment | `{env}`{kwargs} |
| Observation | `{observation}` |
| Action | `{action}` |

## How it was trained

{trained}
"""
FORMS = {
    "policy.onnx": "`policy.onnx` is the same policy, from the raw observation to the action.",
    "numpy/policy.py": "`numpy/` is the same in a file that needs numpy and safetensors alone.",
}
BEGAN = {"weights": "the weights of another run", "clone": "a clone of recorded episodes"}
FILES = {
    "README.md": "the model card",
    "policy.json": "settings, spaces, versions",
    "policy.safetensors": "weights and normaliser",
    "policy.onnx": "the whole policy, for ONNX Runtime",
    "numpy/policy.py": "the whole policy, for numpy and safetensors alone",
    "numpy/policy.safetensors": "the numbers of numpy/policy.py",
}


def card(manifest: Mapping[str, Any], folder: Path) -> str:
    """Writes the card of what is in `folder`.

    Args:
      manifest: `policy.json`.
    """
    config, (observation, action) = manifest["config"], manifest["env_spaces"]
    kwargs = config["env_kwargs"]
    return TEXT.format(
        front=_front(manifest),
        place=PLACE,
        algorithm=config["algorithm"].upper(),
        env=_code(config["env"]),
        steps=f"{manifest['env_steps']:,}",
        member=_code(manifest["members"][0]),
        best=", as it was at its best evaluation during training" * manifest["best"],
        returns=_returns(manifest),
        forms="\n".join(text for name, text in FORMS.items() if (folder / name).exists()),
        kwargs=f" with `{_code(json.dumps(kwargs))}`" if kwargs else "",
        observation=_code(observation),
        action=_code(action),
        trained=_trained(manifest),
    )


def listing(folder: Path) -> list[str]:
    """Names each file of an exported policy, and says what it is, one a line."""
    found = {name: text for name, text in FILES.items() if (folder / name).is_file()}
    width = max(map(len, found), default=0)
    return [f"  {name:<{width}}  {text}" for name, text in found.items()]


def placed(text: str, place: str) -> str:
    """A card, which may have been edited, that names another place: `hf:USER/NAME`."""
    return NAMED.sub(place, text)


def _code(text: str) -> str:
    """A text that cannot end the code or the cell in which it stands."""
    return printable(text).replace("`", "'").replace("|", "/")


def _front(manifest: Mapping[str, Any]) -> str:
    """The Hub's metadata. JSON is YAML, so no text of a run can end a value."""
    config, played = manifest["config"], manifest.get("evaluation")
    env, algorithm = config["env"], config["algorithm"]
    tags = [env, "reinforcement-learning", "deep-reinforcement-learning", algorithm, "sauna"]
    front: dict[str, Any] = {"library_name": "sauna-rl", "tags": tags}
    if played:
        value = f"{played['mean']:.2f} +/- {played['std']:.2f}"
        metric = {"type": "mean_reward", "value": value, "name": "mean_reward", "verified": False}
        result = {
            "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
            "dataset": {"name": env, "type": env},
            "metrics": [metric],
        }
        front["model-index"] = [{"name": algorithm.upper(), "results": [result]}]
    return "\n".join(f"{key}: {json.dumps(value)}" for key, value in front.items())


def _returns(manifest: Mapping[str, Any]) -> str:
    played = manifest.get("evaluation")
    if not played:
        return "It was not evaluated when it was exported."
    success = f", success {played['success_rate']:.0%}" if "success_rate" in played else ""
    return (
        f"**Return {played['mean']:.2f} +- {played['std']:.2f}** (mean and standard deviation over "
        f"{played['episodes']} episodes, most likely actions, seeds {played['seed']} to "
        f"{played['seed'] + played['episodes'] - 1}; min {played['min']:.2f}, max "
        f"{played['max']:.2f}{success}). This is the return of this one policy, not of the method."
    )


def _trained(manifest: Mapping[str, Any]) -> str:
    training = manifest["training"]
    parts = [f"```bash\n{command(manifest)}\n```"]
    if began := BEGAN.get(str(training.get("began"))):
        parts.append(f"It began with {began}, which this command leaves out (`--init-from`).")
    if earlier := [n for n in training.get("steps_before", ()) if type(n) is int]:
        first = ", then ".join(f"{steps:,}" for steps in earlier)
        parts.append(f"The run was first to have {first} env steps, and got more on a resume.")
    returns = training.get("returns", {})
    if returns:
        rows = "\n".join(f"| `{_code(name)}` | {value:.2f} |" for name, value in returns.items())
        parts.append(
            "All members of its run, by the mean training return (sampled actions) of their last "
            f"100 episodes:\n\n| Member | Return |\n|---|---|\n{rows}"
        )
    versions = ", ".join(f"{name} {number}" for name, number in manifest["versions"].items())
    parts.append(f"Versions: {_code(versions)}." if versions else "")
    return "\n\n".join(filter(None, parts))


def command(manifest: Mapping[str, Any]) -> str:
    """What a user types to train the same again."""
    try:
        settings = overrides_of(read_stored(manifest))
    except SaunaError:  # an arm or a preset that exists no more
        settings = dict(manifest["config"])
    env = settings.pop("env")
    flags = " ".join(typed(name, value) for name, value in settings.items() if value != "")
    return printable(f"sauna train {shlex.quote(env)} {flags}").replace("`", "'")
