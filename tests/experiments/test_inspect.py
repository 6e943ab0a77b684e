"""`sauna inspect`: its decisions and numbers are training's, and its page shows just these."""

from __future__ import annotations

import dataclasses
import io
import json
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import chromium
import sauna
from helpers import SMALL, configured, own
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.vex_targets import make_target
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.program import decide as decide_segment
from sauna.algorithm.selection.registry import make_filter
from sauna.algorithm.types import Hypers, Rollout, ScoredStep
from sauna.config.settings import Config
from sauna.envs.wrapping import PLAIN
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.inspect.decisions import advantages, decide
from sauna.experiments.inspect.inspection import (
    Inspection,
    examine,
    pixel_stride,
    principal_components,
)
from sauna.experiments.inspect.page import meaning
from sauna.experiments.inspect.recording import (
    MAX_FRAMES,
    SIDE,
    Frames,
    Recorder,
    _played,
    open_env,
)
from sauna.experiments.inspect.streams import scaled, stream_of
from sauna.system.errors import BadInput
from sauna.training.artifact import load_artifact
from small_envs import Drawn, Lives, Scripted

THRESHOLD = 0.9


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`ppo/0` and `sauna/0`, trained a little, in an environment that can be drawn."""
    path = tmp_path_factory.mktemp("inspect") / "run"
    settings = {
        **SMALL,
        "arm": "ppo,sauna",
        "threshold": THRESHOLD,
        "rollout_steps": 16,
        "processes": 1,
    }
    return sauna.train("small_envs:Drawn", quiet=True, out=path, **settings).path


def examined(run: Path, name: str = "sauna/0", **changes: Any) -> Inspection:
    settings = {"episodes": 12, "deterministic": False, "seed": 3, "frames": False, **changes}
    return examine(run, load_artifact(run), name, **settings, say=print)


@pytest.fixture(scope="module")
def found(run: Path) -> Inspection:
    return examined(run)


def hypers_of(config: Config) -> Hypers:
    return Hypers(*(np.float32(getattr(config, name)) for name in Hypers._fields))


def by_hand(config: Config, vex: np.ndarray) -> tuple[list[float], list[bool], list[int]]:
    """Eq. 7 over a stream `[L, N]` with Python's lists: medians, mask and rollouts of env 0."""
    medians, keep, rollouts, history, kept, tried = [], [], [], [], 0, 0
    for t, row in enumerate(vex):
        if t == 0 or kept == config.rollout_steps or tried == capacity(config):
            rollouts.append(t)
            history, kept, tried = [], 0, 0
        x = np.mean(row) if config.decision == "joint" else row[0]
        middle = np.median(history) if history else np.nan
        keeps = not history or abs(x) / (abs(middle) + 1e-8) >= config.threshold
        if keeps or config.history == "all":
            history += list(row) if config.decision == "joint" else [x]
        medians.append(float(middle))
        keep.append(bool(keeps))
        kept, tried = kept + keeps, tried + 1
    return medians, keep, rollouts


@pytest.mark.parametrize(
    "history, decision, envs, dropped",
    [("all", "env", 1, "replace"), ("kept", "env", 1, "mask"), ("kept", "joint", 3, "replace")],
)
def test_decisions_are_the_rule_written_out(history, decision, envs, dropped) -> None:
    config = dataclasses.replace(
        configured(arm="sauna", threshold=THRESHOLD, rollout_steps=16, minibatches=1),
        envs=envs,
        history=history,
        decision=decision,
        dropped=dropped,
    )
    vex = np.random.default_rng(0).normal(size=(70, envs)).astype(np.float32)
    made = decide(config, scored(vex), jax.random.key(0), hypers_of(config))
    medians, keep, rollouts = by_hand(config, vex)
    assert made.keep.tolist() == keep and made.rollouts == rollouts and len(rollouts) > 1
    np.testing.assert_allclose(made.median, medians, rtol=1e-6)
    np.testing.assert_allclose(made.edge, THRESHOLD * (np.abs(medians) + 1e-8), rtol=1e-6)
    np.testing.assert_array_equal(
        made.prediction, vex.mean(1) if decision == "joint" else vex[:, 0]
    )


def scored(vex: np.ndarray) -> ScoredStep:
    """Steps of which only the Vex prediction `[L, N]` is read."""
    none = np.zeros(vex.shape, np.float32)
    return ScoredStep(none[..., None], none[..., None], none, none, vex)


def test_lost_lives_and_signs_are_what_is_learned() -> None:
    """Three lives of two steps in one game, rewards 5 and -3."""
    policy: Any = SimpleNamespace(
        reset=lambda: None,
        policy=SimpleNamespace(state_size=0),
        see=np.asarray,
        act=lambda observation, deterministic, key: np.array([1]),
        write=lambda action: action[0],
        heads=lambda x: (np.zeros(len(x)), None),
        log_prob=lambda seen, action: np.zeros(len(seen)),
    )
    recorder = Recorder(Lives(), policy, None)
    observation, _ = recorder.reset(seed=0)
    for _ in range(6):
        recorder.step(recorder.act(observation, deterministic=True, key=None))
    played = _played(recorder, [6.0], None)
    assert played.reward.tolist() == [5.0, -3.0] * 3 and played.terminated.sum() == 1
    config = configured(arm="ppo", sign_rewards=True, normalize_rewards=False)
    reward = scaled(config, {}, played.reward)
    assert reward.tolist() == [1.0, -1.0] * 3
    stream: Any = stream_of(policy, config, {}, played)
    assert stream.terminated.tolist() == [False, True] * 3
    assert stream.reward.tolist() == reward.tolist() and stream.action.tolist() == [[1]] * 6


@pytest.mark.parametrize("arm", ["sauna", "random-drop"])
def test_decisions_are_the_collectors(arm) -> None:
    """Of a first rollout, by the function that the collector calls, with the same keys."""
    more = {"drop_rate": 0.4} if arm == "random-drop" else {"threshold": THRESHOLD}
    config = configured(arm=arm, rollout_steps=64, minibatches=1, **more)
    vex = np.random.default_rng(1).normal(size=(40, 1)).astype(np.float32)
    steps, key, hypers = scored(vex), jax.random.key(7), hypers_of(config)
    made = decide(config, steps, key, hypers)
    filter, first = make_filter(config), jax.random.fold_in(key, 0)
    assert filter is not None
    segment = jax.jit(partial(decide_segment, filter))
    state, rows = filter.init(1, capacity(config)), (np.int32(0), np.int32(40))
    _, mask = segment(state, steps, *rows, first, hypers)
    assert made.keep.tolist() == np.asarray(mask)[:, 0].tolist() and 0 < made.keep.sum() < 40


def test_without_a_filter_everything_is_kept() -> None:
    config = configured(arm="ppo", rollout_steps=16, minibatches=1)
    made = decide(config, scored(np.ones((40, 1))), None, hypers_of(config))
    assert made.keep.all() and np.isnan(made.median).all() and made.rollouts == [0, 16, 32]


def test_a_target_keep_rate_has_an_edge_that_moves() -> None:
    config = configured(arm="sauna", keep_rate_target=0.6, rollout_steps=64, minibatches=1)
    vex = np.random.default_rng(4).normal(size=(90, 1)).astype(np.float32)
    made = decide(config, scored(vex), jax.random.key(0), hypers_of(config))
    assert abs(made.keep.mean() - 0.6) < 0.05
    known = ~np.isnan(made.edge)
    assert known.sum() > 80
    size = np.abs(vex[:, 0])
    np.testing.assert_array_equal(made.keep[known], (size >= made.edge)[known])
    assert made.median[5] == pytest.approx(np.median(size[:5]))


def test_the_units_of_signs_are_signs(run, found) -> None:
    config = dataclasses.replace(
        found.member.config, normalize_rewards=False, sign_rewards=True, dropped="mask"
    )
    changed = found._replace(member=found.member._replace(config=config))
    text = "".join(meaning(changed))
    assert "in signs of rewards." in text and "raw units" not in text
    assert f"A rollout ends after {config.rollout_steps} env steps" in text


def test_a_run_is_decided_by_its_own_head_and_settings(run, found) -> None:
    config = found.member.config
    policy = TrainedPolicy(load_artifact(run), "sauna/0")
    _, vex = policy.heads(found.played.observation)
    medians, keep, rollouts = by_hand(config, vex[:, None])
    assert found.decisions.keep.tolist() == keep and found.decisions.rollouts == rollouts
    np.testing.assert_allclose(found.decisions.median, medians, rtol=1e-5)
    assert 0 < sum(keep) < len(keep) and len(rollouts) > 1
    ppo = examined(run, "ppo/0")
    assert ppo.decisions.keep.all() and not ppo.head


def test_the_episodes_are_evaluations(run, found) -> None:
    played = sauna.evaluate(run, member="sauna/0", episodes=12, seed=3, say=print)
    assert found.played.returns == played["members"]["sauna/0"]["returns"]
    ends = found.played.terminated | found.played.truncated
    assert (
        np.diff(np.flatnonzero(ends), prepend=-1).tolist()
        == (played["members"]["sauna/0"]["lengths"])
    )
    assert not np.any(found.played.terminated & found.played.truncated)


def test_advantages_by_hand(run, found) -> None:
    """Rewards over the frozen std; backwards within a rollout; V of what was cut off counts."""
    artifact = load_artifact(run)
    arrays = own(artifact.checkpoint.arrays, "sauna/0")
    std = np.sqrt(arrays["/reward_moments/variance"][0] + 1e-8)
    reward = np.clip(found.played.reward / std, -10, 10)
    np.testing.assert_allclose(found.reward, reward, rtol=1e-12)
    policy, played = TrainedPolicy(artifact, "sauna/0"), found.played
    value, finals = policy.heads(played.observation)[0], policy.heads(played.final)[0]
    np.testing.assert_array_equal(found.value, value)
    starts = {*found.decisions.rollouts}
    later, episode, expected = 0.0, len(finals), np.zeros(len(value))
    for t in reversed(range(len(value))):
        over = played.terminated[t] or played.truncated[t]
        episode -= bool(over)
        after = 0.0 if played.terminated[t] else finals[episode] if over else value[t + 1]
        delta = reward[t] + 0.99 * after - value[t]
        later = delta + (0.0 if over or t + 1 in starts else 0.99 * 0.95 * later)
        expected[t] = later
    np.testing.assert_allclose(found.advantage, expected, rtol=1e-4, atol=1e-5)
    assert played.truncated.any() and played.terminated.any()


def test_advantages_over_kept_steps_are_the_updates() -> None:
    """Of `sauna-reference`: what `make_batch` gives the update, and nothing for dropped steps."""
    random, length = np.random.default_rng(2), 40
    config = configured(arm="sauna-reference", rollout_steps=24, minibatches=1)
    keep = np.zeros((length, 1), bool)
    keep[random.permutation(39)[:23]] = keep[39] = True
    columns = {
        name: random.normal(size=(length, 1)).astype(np.float32)
        for name in ("reward", "value", "next_value")
    }
    ended = random.random((length, 1)) < 0.2
    zeros = np.zeros((length, 1), np.float32)
    columns |= {
        "terminated": ended,
        "truncated": ~ended & (zeros > 0),
        "keep": keep,
        "valid": np.ones((length, 1), bool),
    }
    stream = Rollout(*(columns.get(name, zeros) for name in Rollout._fields[:-1]))
    hypers = hypers_of(config)
    update = jax.jit(partial(make_batch, config=config, target=make_target(config)))
    batch = update(stream, hypers, jax.random.key(0))
    made = advantages(config, stream, [0], hypers)
    np.testing.assert_allclose(made[keep[:, 0]], batch.advantage, rtol=1e-5, atol=1e-6)
    assert np.isnan(made[~keep[:, 0]]).all()


def test_principal_components() -> None:
    random = np.random.default_rng(3)
    plane = random.normal(size=(50, 2)) * [3.0, 1.0]
    turned = plane @ np.linalg.qr(random.normal(size=(5, 5)))[0][:2] + 7.0
    points, shares = principal_components(turned)
    assert points is not None and abs(sum(shares) - 1) < 1e-9 and shares[0] > 0.7
    distances = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (plane, points)]
    np.testing.assert_allclose(*distances, atol=1e-9)
    line, shares = principal_components(np.arange(4.0)[:, None])
    assert line is not None and shares == [1.0]
    np.testing.assert_allclose(line, [[-1.5, 0], [-0.5, 0], [0.5, 0], [1.5, 0]], atol=1e-12)


def test_principal_components_of_many_pictures_are_those_of_some_pixels(monkeypatch) -> None:
    monkeypatch.setattr("sauna.experiments.inspect.inspection.LARGEST", 1_000_000)
    seen = np.zeros((40, 84, 84, 4), np.uint8)
    seen[:20, ::2] = 255
    assert pixel_stride(seen) == 2
    points, shares = principal_components(seen)
    assert points is not None and shares[0] == pytest.approx(1.0)
    assert len(np.unique(np.sign(points[:20, 0]))) == len(np.unique(np.sign(points[20:, 0]))) == 1


def test_pictures_are_few_small_and_of_their_steps(run) -> None:
    from PIL import Image

    drawn = examined(run, frames=True).played.frames
    assert [row for row, _ in drawn] == [*range(len(drawn))]
    frames = [Image.open(io.BytesIO(data)) for _, data in drawn[:3]]
    brightness = [np.asarray(picture.convert("L")).mean() for picture in frames]
    np.testing.assert_allclose(brightness, [0, 20, 40], atol=2)

    class Huge(Scripted):
        def render(self) -> np.ndarray:
            return np.zeros((400, 800, 3), np.uint8)

    taken = Frames(Huge(), print)
    for row in range(3 * MAX_FRAMES):
        taken.take(row)
    rows = [row for row, _ in taken.taken]
    assert MAX_FRAMES / 2 <= len(rows) <= MAX_FRAMES and np.unique(np.diff(rows)).tolist() == [4]
    assert Image.open(io.BytesIO(taken.taken[0][1])).size == (SIDE, SIDE // 2)
    limited = Drawn("rgb_array")
    limited.reset(seed=0)
    limited.spec = SimpleNamespace(max_episode_steps=1000)  # type: ignore[assignment]
    counted = Frames(limited, print)
    for row in range(1000):
        counted.take(row)
    assert [row for row, _ in counted.taken] == [*range(0, 1000, 4)]


@pytest.mark.parametrize("how", ["raises", "gives nothing", "cannot be made"])
def test_what_cannot_be_drawn_is_said_in_one_line(run, monkeypatch, how) -> None:
    def broken(*arguments: Any, **settings: Any) -> Any:
        if how == "gives nothing":
            return None
        if how == "cannot be made" and settings.get("render_mode") is None and len(arguments) < 2:
            return None
        raise RuntimeError("no\ndisplay")

    monkeypatch.setattr(Drawn, "__init__" if how == "cannot be made" else "render", broken)
    said: list[str] = []
    path = sauna.inspect(run, member="sauna/0", say=said.append)
    assert len(said) == 1 and said[0].startswith("no frames: ") and "\n" not in said[0]
    text = path.read_text()
    assert "There are no frames." in text and "<img" not in text


def test_agents_are_refused_before_anything_is_said_of_frames() -> None:
    said: list[str] = []
    for frames in (True, False):
        with pytest.raises(BadInput, match="a page shows one agent"):
            open_env("vector_envs:Agents", {}, PLAIN, frames, said.append)
    assert said == []


def test_bad_input_creates_nothing(run, tmp_path) -> None:
    before = sorted(run.rglob("*"))
    for settings in (
        {"member": "sauna/9"},
        {"episodes": 0},
        {"seed": -1},
        {"out": tmp_path},
        {"out": tmp_path / "none" / "page.html"},
    ):
        with pytest.raises(BadInput):
            sauna.inspect(run, **settings)
    assert sorted(run.rglob("*")) == before and not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_runs_of_the_device_and_of_pictures_are_inspected(tmp_path) -> None:
    for env, more in (
        ("gymnax/CartPole-v1", {}),
        ("small_envs:Picture", {"network": "nature-cnn"}),
    ):
        settings = {**SMALL, "preset": "mujoco", "arm": "sauna", **more}
        settings["out"] = tmp_path / env.replace("/", "-")
        if more:
            del settings["hidden"]
        path = sauna.train(env, quiet=True, **settings).path
        made = examined(path, episodes=2)
        assert made.points is not None and np.isfinite(made.advantage).all()
        expected = made.played.reward
        if made.member.config.backend == "device":
            moments = own(load_artifact(path).checkpoint.arrays, "sauna/0")
            variance = moments["/collect/reward_moments/variance"][0]
            expected = np.clip(expected / np.sqrt(variance + 1e-8), -10, 10)
            np.testing.assert_allclose(made.reward, expected, rtol=1e-6)


# In a browser.

MOVE = """
(s => {s.value = %d; s.dispatchEvent(new Event('input'))})(document.getElementById('time'))
"""


@pytest.fixture(scope="module")
def page(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("page") / "page.html"
    return sauna.inspect(run, member="sauna/0", episodes=12, seed=3, out=out, say=print)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory):
    executable = chromium.find()
    if executable is None:
        pytest.skip(f"no Chromium is installed (looked for {', '.join(chromium.NAMES)})")
    opened = chromium.Page(executable, tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


def data_of(page: Path) -> dict[str, Any]:
    stored = re.search(r'id="data">(.*?)</script>', page.read_text(), re.S)
    assert stored is not None
    return json.loads(stored[1])


def test_the_pages_numbers_are_the_arrays(page, found) -> None:
    data = data_of(page)
    arrays = {
        "vex": found.decisions.prediction,
        "median": found.decisions.median,
        "edge": THRESHOLD * np.abs(found.decisions.median),
        "value": found.value,
        "return": found.value + found.advantage,
        "advantage": found.advantage,
        "reward": found.reward,
        "raw_reward": found.played.reward,
    }
    assert data["series"].keys() == arrays.keys()
    for name, values in arrays.items():
        shown = np.array(data["series"][name], float)
        np.testing.assert_allclose(shown, values, rtol=1e-4, atol=1e-7)
    assert data["keep"] == found.decisions.keep.astype(int).tolist()
    assert data["rollouts"] == found.decisions.rollouts
    np.testing.assert_allclose(np.transpose(data["points"]), found.points, rtol=1e-4)


def test_the_page_needs_nothing_else(page) -> None:
    text = page.read_text()
    assert "default-src 'none'" in text and not re.search(r'(src|href)="(?!data:|#)', text)
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(|WebSocket|@import", text)
    assert "url(" not in text[text.index("<style>") : text.index("</style>")]


def test_other_code_than_that_of_the_run_is_said(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said() -> list[str]:
        lines: list[str] = []
        page = tmp_path / "page.html"
        sauna.inspect(run, member="sauna/0", out=page, frames=False, say=lines.append)
        return [line for line in lines if "other code" in line]

    assert said() == []
    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "bbb 2")
    assert "warning: the rule is asked with today's code" in said()[0] and "bbb" in said()[0]


def test_without_a_head_the_page_says_so(run, browser, tmp_path) -> None:
    path = sauna.inspect(run, member="ppo/0", out=tmp_path / "ppo.html", frames=False)
    assert "There is no Vex prediction: ppo trains no Vex head" in path.read_text()
    assert "vex" not in data_of(path)["series"]
    browser.open(path, width=1280)
    assert browser.run("[...document.querySelectorAll('.track')].map(t => t.dataset.name)") == [
        "value",
        "advantage",
        "reward",
    ]
    assert not browser.complaints()


def shown(browser: chromium.Page) -> dict[str, Any]:
    """What the page shows now: its numbers, and the step that its picture is of."""
    return browser.run("""({
      ...Object.fromEntries([...document.querySelectorAll('#now td')].map(
        cell => [cell.dataset.name, cell.dataset.value ?? cell.textContent])),
      row: document.getElementById('picture').dataset.row,
      picture: document.getElementById('picture').src,
      slider: document.getElementById('time').value,
    })""")


def test_picture_line_and_numbers_are_of_one_step(browser, page, found) -> None:
    browser.open(page, width=1280)
    data, last = data_of(page), len(found.reward) - 1
    first = shown(browser)
    assert first["slider"] == "0" and first["decision"] == "kept"
    dropped = int(np.flatnonzero(~found.decisions.keep)[0])
    browser.run(MOVE % dropped)
    now = shown(browser)
    assert now["decision"] == "dropped" and now["row"] == str(dropped)
    assert now["picture"].endswith(data["frames"]["images"][dropped])
    for name, values in data["series"].items():
        assert float(now[name]) == values[dropped]
    browser.run(MOVE % 0)
    assert shown(browser) == first  # and back
    place = "(r => [r.x, r.y, r.width, r.height])(document.querySelector('.track > svg')"
    browser.run("scrollTo(0, 0)")
    x, y, width, height = browser.run(f"{place}.getBoundingClientRect())")
    for kind in ("mousePressed", "mouseReleased"):
        browser.send(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x + width - 9,
            y=y + height / 2,
            button="left",
            buttons=1,
            clickCount=1,
        )
    assert shown(browser)["slider"] == str(last)
    for kind in ("keyDown", "keyUp"):
        browser.send(
            "Input.dispatchKeyEvent",
            type=kind,
            key="ArrowLeft",
            code="ArrowLeft",
            windowsVirtualKeyCode=37,
        )
    assert shown(browser)["slider"] == str(last - 1)
    assert not browser.complaints()


def test_playing_and_the_scatter_move_the_time(browser, page, found) -> None:
    browser.open(page, width=1280)
    browser.run("document.getElementById('play').click()")
    browser.run("new Promise(done => setTimeout(done, 600))")
    browser.run("document.getElementById('play').click()")
    assert 0 < int(shown(browser)["slider"]) < 40  # ten steps a second
    browser.run("document.getElementById('scatter').scrollIntoView()")
    here = "(c => (r => [r.x + r.width / 2, r.y + r.height / 2])(c.getBoundingClientRect()))"
    browser.run(MOVE % 5)
    x, y = browser.run(f"{here}(document.querySelector('#scatter .here'))")
    browser.run(MOVE % 9)
    browser.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    assert shown(browser)["slider"] == "5"
    assert not browser.complaints()


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_it_without_overflow(browser, page, dark) -> None:
    browser.open(page, width=360, dark=dark)
    assert browser.run("document.documentElement.scrollWidth") == 360
    back = browser.run("getComputedStyle(document.body).backgroundColor")
    assert back == ("rgb(22, 24, 27)" if dark else "rgb(255, 255, 255)")
    assert not browser.complaints()
