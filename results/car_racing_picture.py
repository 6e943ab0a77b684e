"""Writes `docs/images/car_racing.png`: a moment of CarRacing, and what preset `car-racing` sees.

`python results/car_racing_picture.py` needs the extra `box2d`.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
from pictures import store

from sauna.envs.car_racing import EveryEighth

PLACE = Path(__file__).parent.parent / "docs" / "images" / "car_racing.png"
STACK, SEED, STEPS = 4, 5, 9
ACTION = np.array([0.0, 0.25, 0.0], np.float32)  # straight on, some gas


def main() -> None:
    env = EveryEighth(gymnasium.make("CarRacing-v3", render_mode="rgb_array"))
    env.reset(seed=SEED)
    seen = [env.step(ACTION)[0] for _ in range(STEPS)][-STACK:]
    figure = plt.figure(figsize=(9, 3.4), layout="constrained")
    game, *views = figure.subplot_mosaic("AABC;AADE").values()
    for axes, picture in ((game, env.render()), *zip(views, seen, strict=True)):
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
        axes.set_axis_off()
    game.set_title("the game", fontsize=9)
    for k, axes in enumerate(views):
        ago = STACK - 1 - k
        axes.set_title("now" if ago == 0 else f"{ago} step{'s' * (ago > 1)} ago", fontsize=9)
    figure.savefig(PLACE, dpi=110)
    store(PLACE, PLACE)


if __name__ == "__main__":
    main()
