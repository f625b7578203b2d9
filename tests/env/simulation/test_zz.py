import numpy as np


def test_s(make_env):
    env = make_env()
    for r in range(1, 150):
        random = np.random.default_rng(r)
        env.reset(seed=r)
        for _ in range(2):
            env.advance(
                np.r_[random.uniform(-0.08, 0.08, 3), random.uniform(-0.5, 0.5, 3), float(random.random() > 0.5)]
            )
        f = [env.scene.frame().rgb for _ in range(2)]
        if (f[0] != f[1]).any():
            print("ALT", r)
