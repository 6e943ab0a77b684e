"""`sauna.train(...)` in Python, policies, videos, TensorBoard, plug-ins, the picture."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest

import sauna
from command_line import sauna_here
from helpers import SMALL, environment, own
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.report.curve import interval, member_curves
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training.artifact import load_artifact
from small_envs import Finite, Scripted

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.draws


class Listed(sauna.Tracker):
    """A tracker of the user's own, which keeps what it is given."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def open(self, run: sauna.TrackedRun) -> dict:
        return {"urls": dict.fromkeys(run.members, "https://here")}

    def row(self, row) -> None:
        self.calls.append(("row", row["member"], row["env_steps"]))

    def picture(self, name: str, path: Path) -> None:
        self.calls.append(("picture", name, path))

    def summary(self, members, complete: bool) -> None:
        self.calls.append(("summary", members, complete))

    def close(self) -> None:
        self.calls.append(("close",))


LISTED = Listed()


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    run = tmp_path_factory.mktemp("api") / "run"
    return sauna.train(
        "small_envs:Scripted",
        quiet=True,
        out=run,
        track=["tensorboard", LISTED],
        **{**SMALL, "arm": "sauna", "seeds": 2},
    )


def test_rows_hold_every_metric(result) -> None:
    expected = {
        "member",
        "arm",
        "seed",
        "iteration",
        "env_steps",
        "kept_steps",
        "keep_rate",
        "gradient_steps",
        "samples_forward",
        "samples_backward",
        "sample_rate",
        "effective_sample_size",
        "episodes",
        "episode_returns",
        "episode_lengths",
        "episode_return_mean",
        "episode_length_mean",
        "episode_truncated",
        "return_mean",
        "policy_loss",
        "value_loss",
        "vex_loss",
        "entropy",
        "kl",
        "clip_fraction",
        "gradient_norm",
        "policy_std",
        "explained_variance",
        "vex_target",
        "vex_mean",
        "vex_spread",
        "vex_median",
        "learning_rate",
    }
    for row in result.metrics:
        assert set(row) == expected
        assert all(math.isfinite(v) for v in row.values() if isinstance(v, float))
    timing = run_directory.rows(result.path, "timing.jsonl")
    assert [row["iteration"] for row in timing] == sorted({r["iteration"] for r in result.metrics})
    total = sum(row["env_steps"] for row in timing)
    assert total == sum(row["env_steps"] for row in result.summary.values())
    assert all(row["steps_per_second"] > 0 for row in timing)


def test_config_json_says_everything(result) -> None:
    stored = run_directory.read_config(result.path)
    assert stored["config"]["network"] == "mlp"
    assert {"jax", "gymnasium", "numpy", "sauna-rl"} <= set(stored["versions"])
    assert stored["machine"]["cores"] and stored["exact_resume"] is True


def test_the_policy_acts_as_in_training(result) -> None:
    """Normalised by hand, with the stored parameters, in plain numpy."""
    artifact = load_artifact(result.path)
    policy, env = TrainedPolicy(artifact, 1), Scripted()
    observation, _ = env.reset(seed=3)
    arrays = own(artifact.checkpoint.arrays, "sauna/1")
    arrays = {name.removeprefix("/"): value for name, value in arrays.items()}
    last = [row for row in result.metrics if row["member"] == "sauna/1"][-1]
    assert last["policy_std"] == pytest.approx(np.exp(arrays["params/log_std"]).mean(), rel=1e-6)
    mean, variance = arrays["observation_moments/mean"], arrays["observation_moments/variance"]
    x = np.clip((observation - mean) / np.sqrt(variance + 1e-8), -10, 10)
    for layer in ("policy_trunk/layer_0", "policy_trunk/layer_1"):
        x = np.tanh(x @ arrays[f"params/{layer}/kernel"] + arrays[f"params/{layer}/bias"])
    x = x @ arrays["params/policy_head/kernel"] + arrays["params/policy_head/bias"]
    np.testing.assert_allclose(policy(observation), np.clip(x, -1, 1), atol=1e-5)
    samples = [policy(observation, deterministic=False, key=jax.random.key(i)) for i in range(9)]
    assert len({s.tobytes() for s in samples}) == 9
    with pytest.raises(ValueError, match="needs key"):
        policy(observation, deterministic=False)
    assert result.policy(member="sauna/0")(observation).shape == (2,)
    with pytest.raises(BadInput, match="unknown argument 'chekpoint'"):
        sauna.load(result.path, chekpoint=2)
    assert result.policy(member=np.argmax([0.5, 2.0])).name == "sauna/1"
    with pytest.raises(BadInput, match="not between 0 and 1"):
        result.policy(member=np.int64(2))
    for member in (-1, 0.5, True):
        with pytest.raises(BadInput, match="member: must be a whole number of at least 0"):
            result.policy(member=member)


def test_evaluation_does_not_change_the_run_and_repeats(result) -> None:
    before = (
        sorted((result.path / "checkpoints").iterdir())[-1] / "state.safetensors"
    ).read_bytes()
    one = sauna.evaluate(result.path, episodes=4, seed=5)
    two = sauna.evaluate(result.path, episodes=4, seed=5)
    assert one == two and one["mode"] == "sampled"
    best = sauna.evaluate(result.path, episodes=4, seed=5, deterministic=True)
    assert best["mode"] == "deterministic" and best["members"] != one["members"]
    row = one["members"]["sauna/0"]
    assert row["mean"] == pytest.approx(np.mean(row["returns"]))
    only = sauna.evaluate(str(result.path), member=0, episodes=4, seed=5)
    assert only["members"] == {"sauna/0": row}
    for name, value in (("episodes", 0), ("episodes", 2.5), ("seed", -1), ("max_steps", "x")):
        with pytest.raises(BadInput, match=f"{name}: must be a whole number of at least"):
            sauna.evaluate(result.path, **{name: value})
    after = (sorted((result.path / "checkpoints").iterdir())[-1] / "state.safetensors").read_bytes()
    assert before == after


def test_none_is_not_given(result, tmp_path) -> None:
    resumed = sauna.resume(result.path, steps=None, quiet=True)
    assert resumed.metrics == result.metrics
    with pytest.raises(BadInput, match="gamma: "):  # it came past the steps
        sauna.compare("CartPole-v1", steps=None, gamma="x", out=tmp_path)


def test_a_run_that_was_cut_short_has_no_summary_yet(result, tmp_path) -> None:
    shutil.copytree(result.path, tmp_path / "run")
    (tmp_path / "run" / "summary.json").unlink()
    with pytest.raises(SaunaError, match="has no summary yet"):
        _ = sauna.Result(tmp_path / "run").summary


def test_tensorboard_holds_the_same_numbers(result) -> None:
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.plugin_hparams_pb2 import HParamsPluginData

    found: dict[str, list[float]] = {}
    others: dict[str, Any] = {}
    for path in (result.path / "tensorboard" / "sauna" / "0").iterdir():
        blob, at = path.read_bytes(), 0
        while at < len(blob):
            size = int.from_bytes(blob[at : at + 8], "little")
            event = Event.FromString(blob[at + 12 : at + 12 + size])
            for value in event.summary.value:
                found.setdefault(value.tag, []).append(value.simple_value)
                others[value.tag] = value
            at += 12 + size + 4
    rows = [row for row in result.metrics if row["member"] == "sauna/0"]
    for name in ("keep_rate", "vex_mean", "entropy", "kept_steps", "learning_rate"):
        np.testing.assert_allclose(found[name], [row[name] for row in rows], rtol=1e-6)
    finals = {f"final/{n}": x for n, x in result.summary["sauna/0"].items() if isinstance(x, float)}
    assert finals and all(found[name] == [np.float32(x)] for name, x in finals.items())
    (text,) = others["settings/text_summary"].tensor.string_val
    assert b"| seed | `0` |" in text and str(result.path).encode() in text
    started = HParamsPluginData.FromString(
        others["_hparams_/session_start_info"].metadata.plugin_data.content
    ).session_start_info.hparams
    assert started["arm"].string_value == "sauna" and started["gamma"].number_value == 0.99
    assert started["run_directory"].string_value == str(result.path)


def test_a_tracker_of_one_s_own_gets_all_and_the_summary_says_where(result) -> None:
    rows = [call[1:] for call in LISTED.calls if call[0] == "row"]
    assert rows == [(row["member"], row["env_steps"]) for row in result.metrics]
    others = [call for call in LISTED.calls if call[0] != "row"]
    assert others == [
        ("summary", result.summary, True),
        ("picture", "learning_curve", result.path / "figures" / "learning_curve.png"),
        ("close",),
    ]
    (urls,) = run_directory.read_config_file(result.path / "summary.json")["tracking"].values()
    assert urls == {"sauna/0": "https://here", "sauna/1": "https://here"}


def test_a_result_is_a_figure_and_a_table(result, monkeypatch) -> None:
    figure = result.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    lines = [line.get_ydata() for line in figure.axes[0].lines]
    means = [row["return_mean"] for row in result.metrics if row["member"] == "sauna/1"]
    assert any(np.array_equal(line, means) for line in lines)
    monkeypatch.setitem(sys.modules, "pandas", None)  # as if it were not installed
    assert result.table("metrics") == result.metrics
    expected = [{"member": name, **numbers} for name, numbers in result.summary.items()]
    assert result.table() == expected
    with pytest.raises(BadInput, match="'members' or 'metrics'"):
        result.table("rows")


def test_a_table_is_a_data_frame_if_pandas_is_there(result) -> None:
    pandas = pytest.importorskip("pandas")
    table = result.table()
    assert isinstance(table, pandas.DataFrame)
    assert table.to_dict("records") == [{"member": n, **x} for n, x in result.summary.items()]


SCRIPT = """
import sauna

with open("times.txt", "a") as file:
    file.write("run\\n")
result = sauna.train(
    "small_envs:Scripted", quiet=True, out="run", arm="ppo", processes=2, {settings}
)
print(len(result.metrics), result.table().shape if hasattr(result.table(), "shape") else "")
"""


@pytest.mark.slow
def test_a_script_needs_no_main_guard(tmp_path) -> None:
    """Two training processes, each with a process of environments; the script runs once."""
    settings = {**SMALL, "seeds": 2, "env_processes": 1}
    text = ", ".join(f"{name}={value!r}" for name, value in settings.items())
    (tmp_path / "script.py").write_text(SCRIPT.format(settings=text))
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("8 ")
    assert (tmp_path / "times.txt").read_text() == "run\n"


@pytest.mark.processes
def test_functions_and_lambdas_as_environments(tmp_path, capsys) -> None:
    named = sauna.train(Scripted, quiet=True, out=tmp_path / "named", **SMALL)
    assert run_directory.read_config(named.path)["config"]["env"] == "small_envs:Scripted"
    local = sauna.train(lambda: Scripted(), quiet=True, out=tmp_path / "local", **SMALL)
    assert local.metrics == named.metrics


@pytest.mark.slow
def test_videos_are_written_and_read_back(tmp_path) -> None:
    import imageio.v3 as imageio

    run = sauna.train(
        "small_envs:Picture",
        quiet=True,
        out=tmp_path / "run",
        arm="ppo",
        rollout_steps=8,
        minibatches=2,
        epochs=1,
        steps=8,
    )
    played = sauna.evaluate(run.path, episodes=1, video=True)
    frames = imageio.imread(played["video"])
    assert frames.shape[0] == 5 and frames.shape[3] == 3
    brightness = frames.mean((1, 2, 3))
    np.testing.assert_allclose(brightness, np.arange(5) * 20, atol=6)


def test_no_video_is_said_plainly(result) -> None:
    """Before an episode is played."""
    said: list[str] = []
    needs = r"video: a video needs an environment that takes render_mode='rgb_array'"
    with pytest.raises(sauna.BadInput, match=needs):
        sauna.evaluate(result.path, episodes=1, max_steps=1, video=True, say=said.append)
    assert said == []


def test_environments_in_worker_processes_train_to_the_same_bytes(result, tmp_path) -> None:
    other = sauna.train(
        "small_envs:Scripted",
        quiet=True,
        out=tmp_path / "run",
        env_processes=2,
        processes=1,
        **{**SMALL, "arm": "sauna", "seeds": 2},
    )
    assert other.metrics == result.metrics


def test_the_plugin_of_the_docs_runs(tmp_path) -> None:
    """The file of docs/how-to/own_selection_rule.md, as it stands there, from the command line."""
    text = (ROOT / "docs" / "how-to" / "own_selection_rule.md").read_text()
    code = text.split('```python title="my_filters.py"\n')[1].split("```")[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    (tmp_path / "my_filters.py").write_text(code)
    command = next(line for line in text.splitlines() if line.startswith("sauna train"))
    arguments = [*command.split()[1:], "--out", "run", "--seeds", "2"]
    arguments += ["--rollout-steps", "512", "--steps", "1024"]
    done = sauna_here(*arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rates = [row["keep_rate"] for row in run_directory.rows(tmp_path / "run")]
    assert min(rates) > 0.2 and max(rates) < 0.95
    done = sauna_here("inspect", "run", "--no-frames", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (page,) = (tmp_path / "run").glob("inspect_*.html")
    text = page.read_text()  # its rule is not eq. 7, and nothing is made up about it
    assert "The filter is my_filters:lower_half" in text and "inside the band" not in text


@pytest.mark.parametrize("name", ["smoothed", "by_numpy"])
def test_filters_of_ones_own_may_be_plain(name: str, tmp_path) -> None:
    run = sauna.train(
        "small_envs:Scripted",
        quiet=True,
        out=tmp_path / "run",
        arm="sauna",
        filter=f"jax_envs:{name}",
        **SMALL,
    )
    assert all(0 < row["keep_rate"] <= 1 for row in run.metrics)


def test_the_target_of_the_docs_runs(tmp_path, monkeypatch) -> None:
    text = (ROOT / "docs" / "how-to" / "own_vex_target.md").read_text()
    code = text.split('```python title="my_targets.py"\n')[1].split("```")[0]
    (tmp_path / "my_targets.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    run = sauna.train(
        "small_envs:Scripted",
        quiet=True,
        out=tmp_path / "run",
        arm="vex-head",
        vex_target="my_targets:sign",
        **SMALL,
    )
    assert all(0 <= row["vex_target"] <= 1 for row in run.metrics)


def test_python_values_of_all_kinds_are_taken(tmp_path) -> None:
    settings = {
        **SMALL,
        "seeds": range(3, 5),
        "steps": np.int64(64),
        "learning_rate": np.float32(1),
    }
    run = sauna.train(
        "small_envs:Scripted",
        quiet=True,
        out=tmp_path / "run",
        arm=["ppo"],
        env_kwargs={},
        **{**settings, "hidden": None},
    )
    assert set(run.summary) == {"ppo/3", "ppo/4"}


def test_curves_and_their_interval() -> None:
    rows = [
        {"arm": "ppo", "member": f"ppo/{s}", "env_steps": x, "return_mean": float(s + x)}
        for s in (0, 2)
        for x in (1, 2)
    ]
    curves = member_curves([*rows, {"arm": "ppo", "member": "ppo/0", "env_steps": 3}])
    np.testing.assert_array_equal(curves["ppo"]["ppo/2"][1], [3.0, 4.0])
    low, high = interval(np.array([[1.0], [3.0]]))
    half = 12.706204736 * math.sqrt(2) / math.sqrt(2)  # t(1) at 97.5%, std sqrt(2), 2 members
    np.testing.assert_allclose([low[0], high[0]], [2 - half, 2 + half], rtol=1e-6)


@pytest.mark.slow
def test_a_live_table_shows_the_members(monkeypatch, capsys, tmp_path) -> None:
    from sauna.training import display

    monkeypatch.setattr(display.sys.stdout, "isatty", lambda: True, raising=False)
    shown = display.make_display()
    assert isinstance(shown, display.LiveDisplay)
    sauna_run = sauna.api.runs.start(
        {"env": "small_envs:Finite", "arm": "sauna", "out": str(tmp_path / "run"), **SMALL}, shown
    )
    sauna.api.train_and_draw(sauna_run, shown, resume=False)
    text = capsys.readouterr().out
    for word in ("sauna/0", "env steps", "keep rate", "Vex mean", "Vex spread"):
        assert word in text


def test_unknown_settings_name_the_nearest() -> None:
    with pytest.raises(BadInput, match="unknown key 'treshold'; did you mean 'threshold'"):
        sauna.train(Finite, treshold=1)
    assert json.dumps(sauna.__all__) and isinstance(Finite(), gymnasium.Env)


@pytest.mark.parametrize("how", [{"arms": "ppo,sauna"}, {"rules": "gigaflow,pods"}])
def test_a_comparison_takes_names_in_a_text_or_in_a_list(how: dict[str, str]) -> None:
    """Both get as far as the steps, with the same arms; a name that is none is refused whole."""
    ((name, text),) = how.items()
    said = []
    for names in (text, text.split(",")):
        with pytest.raises(BadInput, match="steps: 9 is less than one rollout") as error:
            sauna.compare("small_envs:Scripted", steps=9, quiet=True, **{name: names})
        said.append(str(error.value))
    assert said[0] == said[1]
    with pytest.raises(BadInput, match="'nope'"):
        sauna.compare("small_envs:Scripted", quiet=True, **{name: f"{text},nope"})
