"""CarRacing in every eighth picture."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from sauna.config.presets import AUTO, resolve
from sauna.config.task_presets import TASK_PRESETS
from sauna.config.trust import OWN_WRAPPERS, named_code
from sauna.envs.car_racing import EveryEighth
from sauna.envs.make import make_env
from sauna.envs.small_grey import SIDE, SmallGrey
from sauna.envs.wrapping import Wrapping, wrapping_of
from sauna.system.errors import BadInput
from small_envs import Colours

PATH = "sauna.envs.car_racing:EveryEighth"


class Racing(Colours):
    """Draws in each step, as Gymnasium's CarRacing does, and counts it."""

    length, car, drawn = 20, None, 0

    def observe(self) -> np.ndarray:
        self.state = self._render("state_pixels")
        return self.state

    def _render(self, mode: str) -> np.ndarray:
        self.drawn += 1
        return super().observe()


class AlwaysDrawn(SmallGrey):
    times = 8


def test_pictures_that_nobody_sees_are_not_drawn_and_the_others_stay_the_same() -> None:
    racing, always = EveryEighth(Racing()), AlwaysDrawn(Racing())
    for _ in range(2):
        np.testing.assert_array_equal(racing.reset(seed=0)[0], always.reset(seed=0)[0])
        for t in (8, 16, 20):  # the episode ends at an undrawn step
            (seen, *rest), (expected, *others) = racing.step(0), always.step(0)
            np.testing.assert_array_equal(seen, expected)
            assert rest == others and racing.unwrapped.t == t
        assert rest[1] and seen.max() == round(0.299 * 10 * 20)
    assert racing.unwrapped.drawn == 2 * (1 + 3)
    assert always.unwrapped.drawn == 2 * (1 + 20)


def test_another_environment_is_refused_in_a_line() -> None:
    with pytest.raises(BadInput, match=f"wrap: {PATH} cannot wrap .*CarRacing") as error:
        make_env("small_envs:Colours", {}, Wrapping((PATH,)))
    assert "\n" not in str(error.value)


def test_the_preset_takes_it_and_nobody_has_to_trust_it() -> None:
    config = resolve({"env": "CarRacing-v3", "preset": AUTO})
    assert wrapping_of(config) == Wrapping((PATH,), 4)
    wrappers = {path for preset in TASK_PRESETS.values() for path in preset.get("wrap", ())}
    assert wrappers <= set(OWN_WRAPPERS)
    assert named_code({"config": {"wrap": [PATH], "env": PATH}}) == [["env", PATH]]


@pytest.mark.slow
@pytest.mark.parametrize("steer", [None, 0.0])
def test_gymnasium_s_pictures_stay_the_same(steer: float | None) -> None:
    pytest.importorskip("Box2D", reason="needs `pip install 'sauna-rl[box2d]'`")

    def played(wrapper: Any) -> list[Any]:
        env = wrapper(gymnasium.make("CarRacing-v3"))
        random = np.random.default_rng(0)
        found = [env.reset(seed=0)[0].tobytes()]
        while True:  # straight on it leaves the field, else its time ends
            turn = random.uniform(-1, 1) if steer is None else steer
            seen, *rest, _ = env.step(np.array([turn, 1.0, 0.0], np.float32))
            found += [seen.tobytes(), *rest]
            if rest[1] or rest[2]:
                assert seen.shape == (SIDE, SIDE, 1)
                return found

    assert played(EveryEighth) == played(AlwaysDrawn)
