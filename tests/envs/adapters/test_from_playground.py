import sys

import jax
import numpy as np
import pytest

import envs
from envs.adapters import from_playground

NAMES = ("CartpoleBalance", "PendulumSwingup", "AcrobotSwingup", "PointMass")


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    from_playground.load.cache_clear()
    with pytest.raises(ValueError, match=r'needs the package playground .*Install the extra: .*"\.\[playground\]"'):
        envs.check_name("playground:CartpoleBalance")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_same_as_playground_itself(name):
    registry = pytest.importorskip("mujoco_playground").registry
    env, raw = envs.make(f"playground:{name}"), registry.load(name, config_overrides={"impl": "jax"})
    key = jax.random.key(2)
    start_key, _ = jax.random.split(key)
    state = jax.jit(env.reset)(key)
    with jax.numpy_rank_promotion("allow"):
        expected = jax.jit(raw.reset)(jax.random.key_data(start_key))
        raw_step = jax.jit(raw.step)
    step = jax.jit(env.step)
    np.testing.assert_allclose(state.obs, expected.obs, atol=1e-6)
    assert env.spec.episode_steps == 1000
    for action in np.random.default_rng(0).uniform(-1, 1, (10, env.spec.action_size)).astype(np.float32):
        state, transition = step(state, action)
        with jax.numpy_rank_promotion("allow"):
            expected = raw_step(expected, action)
        np.testing.assert_allclose(transition.next_obs, expected.obs, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(transition.reward, expected.reward, rtol=1e-4, atol=1e-4)
        assert bool(transition.terminated) == bool(expected.done)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("playground:CartpolBalance", {}, r"is not known\. Did you mean 'playground:CartpoleBalance'"),
        ("playground:CartpoleBalance", {"backend": "warp"}, r"backend='warp' is not known\. Allowed: auto, mjx"),
        ("playground:CartpoleBalance", {"episode_steps": 0}, "episode_steps=0 is out of range"),
    ],
)
def test_refusals(name, options, message):
    pytest.importorskip("mujoco_playground")
    with pytest.raises(ValueError, match=message):
        envs.make(name, **options)
