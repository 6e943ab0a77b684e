"""Policies go to a hub on this machine and come back, by the Hugging Face Hub's own client."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import sauna
from fake_hub import FakeHub, serving
from sauna import cli
from sauna.system import hub as client
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training.located import zoo

OWN = zoo()["CartPole-v1"]  # an exported policy


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHub]:
    pytest.importorskip("huggingface_hub", reason="needs `pip install 'sauna-rl[hub]'`")
    found = FakeHub()
    with serving(found) as address:
        monkeypatch.setenv("HF_ENDPOINT", address)
        monkeypatch.setenv("HF_TOKEN", "hf_right")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        yield found


@pytest.mark.slow
def test_a_policy_goes_there_and_back(hub: FakeHub, tmp_path: Path, capsys) -> None:
    cli.main(["push", str(OWN), "me/pole", "--private"])
    assert "/me/pole/commit/" in capsys.readouterr().out
    assert hub.private == {"me/pole"} and "Bearer hf_right" in hub.tokens
    stored = hub.branches["me/pole", "main"]
    assert set(stored) == {"README.md", "policy.json", "policy.safetensors"}
    for text in (b"sauna eval hf:me/pole --", b'sauna.load("hf:me/pole")'):
        assert text in stored["README.md"] and b"zoo:" not in stored["README.md"]
    stored["evil.py"] = stored["numpy/evil.py"] = b"raise SystemExit"
    cli.main(["pull", "me/pole", str(tmp_path / "back")])
    back = {str(p.relative_to(tmp_path / "back")) for p in (tmp_path / "back").rglob("*")}
    assert back == {"README.md", "policy.json", "policy.safetensors"}
    seen = np.linspace(-1, 1, 20).reshape(5, 4).astype(np.float32)
    expected = sauna.load(OWN)(seen)
    np.testing.assert_array_equal(sauna.load(tmp_path / "back")(seen), expected)
    np.testing.assert_array_equal(sauna.load("hf:me/pole")(seen), expected)
    with pytest.raises(BadInput, match="is not empty"):
        sauna.pull("me/pole", tmp_path / "back")


@pytest.mark.slow
def test_a_revision_is_one_of_its_own(hub: FakeHub, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    sauna.push(OWN, "me/pole")
    hub.branches["me/pole", "main"]["policy.json"] = b"{}"
    sauna.push(zoo()["Pendulum-v1"], "me/pole", revision="second")
    assert "Pendulum" in str(sauna.load("hf:me/pole@second").config.env)
    with pytest.raises(SaunaError):
        sauna.load("hf:me/pole")
    result = sauna.evaluate("hf:me/pole@second", episodes=1)
    written = tmp_path / "runs" / "hf-me-pole@second" / "evaluation_sampled.json"
    assert json.loads(written.read_text())["members"] == result["members"]


@pytest.mark.slow
def test_what_the_hub_refuses_is_one_line(hub: FakeHub, tmp_path: Path, monkeypatch) -> None:
    for name in ("nobody/nothing", "nobody/nothing@x"):
        with pytest.raises(SaunaError, match=r"hub: .*404"):
            sauna.pull(name, tmp_path / "new")
    with monkeypatch.context() as other:
        other.setenv("HF_TOKEN", "hf_wrong")
        with pytest.raises(SaunaError, match=r"hub: .*401"):
            sauna.push(OWN, "me/pole")
    hub.branches["some/model", "main"] = {"config.json": b"{}"}
    with pytest.raises(BadInput, match="some/model holds no policy of SAUNA"):
        sauna.pull("some/model", tmp_path / "new")
    monkeypatch.setattr(client, "LARGEST", 10)
    hub.branches["some/model", "main"] = {"policy.json": b"{}" * 10}
    with pytest.raises(BadInput, match="has more than 10 bytes"):
        sauna.pull("some/model", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_commit_in_the_cache_opens_without_the_network(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(client, "_client", None)
    folder = tmp_path / "sauna/hub/me/pole" / ("0a" * 20)
    shutil.copytree(OWN, folder)
    assert client.cached(f"me/pole@{folder.name}") == folder


@pytest.mark.parametrize("name", ["pole", "a/b/c", "me/../x", "me/pole@", "me/..", ""])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(BadInput, match="is not USER/NAME"):
        client.read_name(name)


def test_an_exported_policy_is_pushed_as_it_is() -> None:
    with pytest.raises(BadInput, match=r"best: .* is exported already"):
        sauna.push(OWN, "me/pole", best=True)


def test_a_policy_of_the_zoo_plays_where_nothing_is_written_into_the_package(
    tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(OWN.iterdir())
    cli.main(["eval", "zoo:CartPole-v1", "--episodes", "1", "--deterministic"])
    assert "return 500.00" in capsys.readouterr().out
    assert (tmp_path / "runs/zoo-CartPole-v1/evaluation_deterministic.json").exists()
    assert sorted(OWN.iterdir()) == before
    with pytest.raises(BadInput, match=r"no policy 'CartPol-v1' \(known: .*did you mean"):
        sauna.load("zoo:CartPol-v1")


@pytest.mark.parametrize("name", zoo())
def test_policies_of_the_zoo_are_small_and_name_no_code(name: str) -> None:
    stored = run_directory.read_config(zoo()[name], exported=True)
    assert sum(path.stat().st_size for path in zoo()[name].iterdir()) < 600_000
    assert stored["seal"]["code"] == [] and stored["evaluation"]["episodes"] == 20
    assert f"sauna eval zoo:{name}" in (zoo()[name] / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo())
def test_policies_of_the_zoo_play_as_their_cards_say(name: str) -> None:
    """By the spread that the card says: an episode's rounding differs from compiler to compiler."""
    stored = run_directory.read_config(zoo()[name], exported=True)
    played = stored["evaluation"]
    found = sauna.evaluate(f"zoo:{name}", episodes=2, deterministic=True, seed=played["seed"])
    (member,) = found["members"].values()
    assert member["mean"] == pytest.approx(played["mean"], abs=3 * played["std"] + 1e-3)
