"""The intrinsic reward in Gymnasium's loops."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import jaxplore
from envs.wrappers import IntrinsicConfig, IntrinsicReward, unit_action
from jaxplore import Belief, FitConfig, Prediction, Reward, make_no_belief

CONFIG = IntrinsicConfig(intrinsic_weight=2.0, extrinsic_weight=10.0, warm_up_steps=6, fit_every=4, data_capacity=8)


class Counter(gymnasium.Env):
    """Counts up by the action, from -2 to 2; the reward is 1; an episode is 5 steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-2.0, 2.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.count = np.zeros(2), 0
        return self.at.copy(), {}

    def step(self, action):
        self.at, self.count = self.at + action[0], self.count + 1
        return self.at.copy(), 1.0, False, self.count == 5, {"own": 7}


class Many(Counter):
    """The same with three choices."""

    action_space = spaces.Discrete(3, start=-1)

    def step(self, action):
        return super().step([action])


def fitted(num_models: int = 2) -> Belief:
    """A belief whose models stand as far from 0 as it has been fitted often, half of them on each side."""

    def update(key, state, data, normalizers):
        return {"fits": state["fits"] + 1, "size": data.size.astype(jnp.float32)}, {}

    def predict(models, inputs):
        sides = jnp.where(jnp.arange(num_models) % 2 == 0, 1.0, -1.0)
        return Prediction((sides * models["fits"])[:, None, None] * jnp.ones((num_models, len(inputs), 2)))

    return Belief(
        init=lambda key: {"fits": jnp.zeros(()), "size": jnp.zeros(())},
        update=update,
        sample=lambda key, state, num: state,
        predict=predict,
        num_models=num_models,
        fit_config=FitConfig(epochs=0, steps=1, restart=False),
    )


def test_rewards_are_mixed_as_the_weights_say():
    env = IntrinsicReward(Counter(), CONFIG, fitted())
    env.reset(seed=0)
    found = []
    for step in range(16):
        _, reward, _, truncated, info = env.step(np.array([0.5]))
        assert info.keys() == {"own", "intrinsic_reward", "extrinsic_reward"}
        assert (info["own"], info["extrinsic_reward"]) == (7, 1.0)
        assert reward == 10.0 + 2.0 * info["intrinsic_reward"]
        found.append(info["intrinsic_reward"])
        assert truncated == ((step + 1) % 5 == 0)
        if truncated:
            env.reset()
    # fitted after 6 steps, and after each 4: models at +n and -n, two entries: the variance is 2 n^2
    assert found == [0.0] * 6 + [2.0] * 4 + [8.0] * 4 + [18.0] * 2
    assert env.unit == "normalised delta, squared"


def test_what_it_learns_from_is_what_happened():
    # successors are true at the end of an episode, actions in [-1, 1], and the replay holds the latest
    env = IntrinsicReward(Counter(), CONFIG, fitted())
    env.reset(seed=0)
    for step in range(10):
        *_, truncated, _ = env.step(np.array([0.1 * step]))
        if truncated:
            env.reset()
    assert env._knowledge is not None
    data = env._knowledge.data
    assert int(data.size) == 8 and float(env._knowledge.belief["size"]) == 8
    order = np.argsort(np.asarray(data.rows.action)[:, 0])
    rows = [np.asarray(leaf)[order] for leaf in data.rows]
    np.testing.assert_allclose(rows[1][:, 0], 0.05 * np.arange(2, 10), atol=1e-6)
    np.testing.assert_allclose(rows[3] - rows[0], 0.1 * np.arange(2, 10)[:, None] * np.ones(2), atol=1e-6)
    assert rows[5].tolist() == [step % 5 == 4 for step in range(2, 10)] and not rows[4].any()
    assert float(env._knowledge.normalizers.delta.count) == 10


def test_a_transition_that_is_not_finite_is_no_data():
    env = IntrinsicReward(Counter(), CONFIG, fitted())
    env.reset(seed=0)
    for step in range(10):
        _, reward, *_, info = env.step(np.array([np.nan if step == 7 else 1.0]))
        assert np.isfinite(reward) and np.isfinite(info["intrinsic_reward"])
        if step == 7:
            env.reset()
    assert env._knowledge is not None
    assert float(env._knowledge.normalizers.obs.count) == 9


def test_any_belief_and_reward_of_the_library():
    far = Reward(lambda prediction, delta, normalizers: jnp.sum(jnp.abs(delta), axis=-1), "normalised delta")
    belief = jaxplore.make_ensemble_belief(
        *(2, 3),
        gaussian=True,
        dynamics_config=jaxplore.DynamicsConfig(hidden=(8,)),
        ensemble_config=jaxplore.EnsembleConfig(num_members=3),
        fit_config=FitConfig(epochs=0, steps=2, batch_size=4),
    )
    env = IntrinsicReward(Many(), CONFIG, belief, far)
    env.reset(seed=0)
    bonuses = {}
    for step in range(12):
        choice = (-1, 0, 1)[step % 3]
        *_, info = env.step(choice)
        bonuses.setdefault(choice, []).append(info["intrinsic_reward"])
    assert env.unit == "normalised delta"
    # changes of -1, 0 and 1 have the mean 0: what has happened is read off the transition itself
    assert bonuses[0][-1] < 0.5 < bonuses[1][-1]


def test_actions_as_the_library_has_them():
    box = spaces.Box(np.array([0.0, -1.0]), np.array([10.0, 1.0]), dtype=np.float64)
    assert unit_action(box, [0.0, 0.5]).tolist() == [-1.0, 0.5]
    assert unit_action(box, [20.0, -3.0]).tolist() == [1.0, -1.0]
    assert unit_action(spaces.Discrete(3, start=-1), 1).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"observation_space": spaces.Box(0, 1, (4, 4))}, r"^observation_space=Box\(.* Allowed: a Box of one axis"),
        ({"observation_space": spaces.Discrete(3)}, r"^observation_space=Discrete\(3\) has observations of another"),
        ({"action_space": spaces.Box(-np.inf, np.inf, (1,))}, r"^action_space=Box\(.* Allowed: a Box with finite"),
        ({"action_space": spaces.MultiBinary(2)}, r"^action_space=MultiBinary\(2\) has actions of another kind"),
    ],
)
def test_spaces_that_do_not_fit_are_refused(change: dict, text: str):
    env = Counter()
    for name, space in change.items():
        setattr(env, name, space)
    with pytest.raises(ValueError, match=text):
        IntrinsicReward(env)


def test_settings_that_make_no_sense_are_refused():
    for field, value in (("fit_every", 0), ("intrinsic_weight", np.nan), ("data_capacity", 3), ("warm_up_steps", 0)):
        with pytest.raises(ValueError, match=rf"^IntrinsicConfig\.{field}={value}"):
            IntrinsicConfig(**{"fit_every": 4, field: value})
    with pytest.raises(ValueError, match=r"^belief=.* predicts nothing\. Allowed: a belief with `predict`"):
        IntrinsicReward(Counter(), belief=make_no_belief())
    with pytest.raises(ValueError, match=r"step was called before reset\. Allowed: reset first\."):
        IntrinsicReward(Counter()).step(np.zeros(1))


def test_a_pendulum_by_the_papers_belief():
    # where it has been for long is worth less than where it is thrown to: the wheel turns at 8 rad/s, not at 0
    env = IntrinsicReward(gymnasium.make("Pendulum-v1"), IntrinsicConfig(extrinsic_weight=0.0, fit_every=50))
    env.reset(seed=0)
    env.unwrapped.state = np.array([np.pi, 0.0])  # pyright: ignore
    for _ in range(199):
        env.step(np.zeros(1))
    env.reset(seed=0)
    found = []
    for step in range(160):
        if step == 150:
            env.unwrapped.state = np.array([0.0, 8.0])  # pyright: ignore
        _, reward, *_ = env.step(np.zeros(1) if step < 150 else np.full(1, 2.0))
        found.append(reward)
    assert found[:57] == [0.0] * 57 and found[57] > 0.0
    assert np.mean(found[151:]) > 3 * np.mean(found[100:150])


def test_stable_baselines3_learns_from_it():
    baselines = pytest.importorskip("stable_baselines3")
    env = IntrinsicReward(gymnasium.make("Pendulum-v1"), IntrinsicConfig(warm_up_steps=64, fit_every=50))
    model = baselines.PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=1, seed=0)
    model.learn(256)
    bonuses = [info["intrinsic_reward"] for info in [env.step(np.zeros(1))[-1]]]
    assert model.num_timesteps == 256 and bonuses[0] > 0
