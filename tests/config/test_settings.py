"""What is said of a setting at the setting is what the checks, resuming and studies read."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from sauna.config import presets
from sauna.config.checks import check_read, check_read_here, is_read
from sauna.config.fields import GROUPS
from sauna.config.settings import (
    FIELDS,
    FILTERS,
    TYPES,
    VEX_TARGETS,
    Config,
    fields_with,
    parse,
)
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput

DISCRETE = Spaces("vector", (3,), "discrete", (2,), "", "")
PICTURES = Spaces("image", (84, 84, 4), "continuous", (2,), "", "")


@pytest.mark.parametrize("name", [name for name, kind in TYPES.items() if kind is not str])
def test_what_cannot_be_read_is_answered_with_what_is_expected(name: str) -> None:
    with pytest.raises(BadInput, match=f"^{name}: cannot read .* as (a|whole|yes|names)"):
        parse(name, object())


def test_every_field_has_a_group_and_ten_or_so_come_first() -> None:
    assert {field.metadata["group"] for field in FIELDS.values()} == set(GROUPS)
    assert 8 <= len(fields_with("common")) <= 12


@pytest.mark.parametrize("name", [n for n, f in FIELDS.items() if f.metadata["read_when"]])
def test_a_field_that_nothing_reads_is_refused_with_what_would_read_it(name: str) -> None:
    kl = name in ("desired_kl", "learning_rate_min", "learning_rate_max")
    unread = dataclasses.replace(
        Config(),
        algorithm="a2c" if name not in ("rmsprop_epsilon", "rmsprop_decay") else "ppo",
        optimizer="rmsprop" if name == "adam_epsilon" else "adam",
        backend="device",
        network="nature-cnn",
        filter="none",
        vex_coef=0.0,
        normalize_observations=False,
        normalize_rewards=False,
        normalize_advantages=False,
        advantage_sign="positive" if name == "normalize_advantages" else "both",
        learning_rate_schedule="constant" if kl else "kl",
        distribution="beta" if name in ("log_std_init", "rescale_actions") else "gaussian",
    )
    needed = FIELDS[name].metadata["read_when"][0]
    assert not is_read(name, unread)
    with pytest.raises(BadInput) as refused:
        check_read([unread], [name])
    assert str(refused.value).startswith(f"{name}: not read by arm") and needed in str(
        refused.value
    )


def test_what_place_and_spaces_leave_unread() -> None:
    host, device = Config(), dataclasses.replace(Config(), backend="device")
    for name in fields_with("device_only"):
        with pytest.raises(BadInput, match="only read with backend device"):
            check_read_here(host, DISCRETE, {name: 1})
        check_read_here(device, DISCRETE, {name: 1})
    with pytest.raises(BadInput, match=r"log_std_init: not read by .*continuous actions"):
        check_read_here(host, DISCRETE, {"log_std_init": 1.0})
    check_read_here(host, PICTURES, {"log_std_init": 1.0})
    with pytest.raises(BadInput, match="no running moments"):
        check_read_here(host, PICTURES, {"normalize_observations": True})
    check_read_here(host, PICTURES, {"normalize_observations": False})
    check_read_here(host, DISCRETE, {"normalize_observations": True})


def test_what_resume_may_change_shapes_no_program() -> None:
    assert not set(fields_with("resumable")) & set(fields_with("shapes_program"))


def test_every_choice_that_has_a_name_has_a_help_line() -> None:
    assert set(presets.CONTROL_HELP) == set(presets.CONTROLS)
    assert set(presets.FILTER_HELP) == set(FILTERS) and set(presets.TARGET_HELP) == set(VEX_TARGETS)
    assert set(presets.ARM_HELP) == set(presets.ARMS)
    assert set(presets.PRESET_HELP) == set(presets.PRESETS)


@pytest.mark.parametrize("number", [3, "3", 3.0, np.int64(3), np.array(3)[()]])
def test_a_number_of_seeds_may_be_numpys(number: Any) -> None:
    assert parse("seeds", number) == (0, 1, 2)
    assert parse("seeds", np.arange(4, 6)) == parse("seeds", range(4, 6)) == (4, 5)
    for bad in (None, True, iter([1]), np.float64(1.5)):
        with pytest.raises(BadInput, match="seeds: cannot read"):
            parse("seeds", bad)
