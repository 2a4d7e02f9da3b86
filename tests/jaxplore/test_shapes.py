"""What JAX would broadcast in silence, or refuse in words of its own, is refused by name when it is traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxplore as jx
from jaxplore import dynamics, replay, rewards

B, O, A, M = 5, 3, 2, 4  # noqa: E741
KEY = jax.random.key(0)
SMALL = jx.DynamicsConfig(hidden=(4,))
FACTORIES = (
    *(jx.make_sac, jx.make_ddqn, jx.make_ddpg, jx.make_ppo, jx.make_ensemble_belief, jx.make_generator_belief),
    lambda obs_size, action_size: jx.make_rnd(obs_size) and jx.make_uniform(action_size),
)


def batch(num=B, obs_size=O, action_size=A, **changes):
    """Of zeros."""
    flag, obs = np.zeros(num, bool), np.zeros((num, obs_size), np.float32)
    action, reward = np.zeros((num, action_size), np.float32), np.zeros(num, np.float32)
    return jx.Transition(obs, action, reward, obs, flag, flag)._replace(**changes)


@pytest.mark.parametrize("factory", FACTORIES)
def test_sizes_below_1_are_refused_when_a_part_is_made(factory):
    # NumPy's whole numbers are as good as Python's
    factory(np.int64(O), A)
    for sizes, message in (
        ((0, A), "obs_size=0 is out of range"),
        ((O, -1), "(action_size|num_actions)=-1 is out"),
        ((2.0, A), r"obs_size=2\.0 is out of range\. Allowed: a whole number, 1 or more"),
    ):
        with pytest.raises(jx.FieldError, match=message):
            factory(*sizes)


def test_sizes_below_1_are_refused_by_behaviours_and_explorers():
    # whatever learner and belief they are given
    belief, sac = jx.make_ensemble_belief(O, A, M, dynamics_config=SMALL), jx.make_sac(O, A)
    reward = jx.Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "squared")
    signal = jx.make_belief_signal(belief, reward)
    for make in (
        lambda obs, action: jx.make_imagination(signal, sac, obs, action, jx.ImaginationConfig()),
        lambda obs, action: jx.make_reactive(signal, sac, obs, action),
        lambda obs, action: jx.make_gradient_policy(signal, obs, action),
        lambda obs, action: jx.make_tree_search(signal, obs, action),
        lambda obs, action: jx.make_model_free(sac, obs, action),
        lambda obs, action: jx.make_explorer(jx.get_method("random"), jx.Sizes(obs, action), jx.ExplorationConfig()),
    ):
        for sizes in ((0, A), (O, -1)):
            with pytest.raises(jx.FieldError, match=r"=(0|-1) is out of range\. Allowed: a whole number, 1 or more"):
                make(*sizes)


WRONG = [
    (batch(obs_size=1), r"batch\.obs=\(5, 1\) is its shape\. Allowed: shape \[B, 3\]"),
    (batch(num=0), r"batch\.obs=\(0, 3\) is its shape\. Allowed: shape \[B, 3\], B 1 or more"),
    (batch(action_size=1), r"batch\.action=\(5, 1\) is its shape\. Allowed: shape \[5, 2\]"),
    (batch(next_obs=np.zeros((1, O))), r"batch\.next_obs=\(1, 3\)"),
    (batch(reward=np.zeros((B, 1))), r"batch\.reward=\(5, 1\) is its shape\. Allowed: shape \[5\]"),
    (batch(terminated=np.zeros(1, bool)), r"batch\.terminated=\(1,\)"),
]


@pytest.mark.parametrize(
    "learner",
    [
        jx.make_sac(O, A, jx.SACConfig(hidden=(4,))),
        jx.make_ddqn(O, A, jx.DDQNConfig(hidden=(4,))),
        jx.make_ddpg(O, A, jx.DDPGConfig(hidden=(4,))),
    ],
)
def test_learners_refuse_batches_and_observations_of_other_shapes(learner):
    state = jax.eval_shape(learner.init, KEY)
    jax.eval_shape(learner.update, KEY, state, batch())
    for rows, message in WRONG:
        with pytest.raises(jx.FieldError, match=message):
            jax.eval_shape(learner.update, KEY, state, rows)
    for act in (
        lambda state, obs: learner.act(KEY, learner.actor(state), obs),
        lambda state, obs: learner.act_greedily(learner.actor(state), obs),
    ):
        with pytest.raises(jx.FieldError, match=r"obs=\(5, 1\) is its shape\. Allowed: shape \[\.\.\., 3\]"):
            jax.eval_shape(act, state, np.zeros((B, 1)))


def zeros(*shape):
    return jnp.zeros(shape)


def prediction(*shape):
    return jx.Prediction(zeros(*shape))


def of_belief(call, gaussian=True):
    """What `call(belief, models, normalizers)` gives, traced."""
    belief = jx.make_ensemble_belief(O, A, M, gaussian=gaussian, dynamics_config=SMALL)
    normalizers = dynamics.init_normalizers(O, A)
    return jax.eval_shape(lambda key: call(belief, belief.sample(key, belief.init(key), M), normalizers), KEY)


def of_explorer(call):
    """What `call(explorer, state)` gives, traced."""
    explorer = jx.make_explorer(jx.get_method("max"), jx.Sizes(O, A), jx.ExplorationConfig(dynamics=SMALL))
    return jax.eval_shape(lambda key: call(explorer, explorer.init(key)), KEY)


def of_rnd(call):
    """What `call(rnd, state)` gives, traced."""
    rnd = jx.make_rnd(O, jx.RNDConfig(hidden=(4,), features=4))
    return jax.eval_shape(lambda key: call(rnd, rnd.init(key)), KEY)


def of_ppo(obs=(B, O), action=(B, A), log_prob=(B,)):
    """An update of PPO on arrays of these shapes, traced."""
    ppo = jx.make_ppo(O, A, jx.PPOConfig(hidden=(4,), rollout_steps=B, minibatch_size=1))
    steps = batch(obs=zeros(*obs), action=zeros(*action))
    rollout = jx.learners.ppo.Rollout(steps, zeros(B), zeros(*log_prob))
    return jax.eval_shape(lambda key: ppo.update(key, ppo.init(key), rollout, zeros(O), jnp.int32(B)), KEY)


STATS = dynamics.init_normalizers(O, A)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rewards.variance(prediction(M, B, O), zeros(1)), r"delta_std=\(1,\) is its shape.*\[3\]"),
        (lambda: rewards.jensen_shannon(prediction(B, O)), r"prediction\.mean=\(5, 3\) is its shape"),
        (lambda: rewards.prediction_error(prediction(M, B, O), zeros(B, 1)), r"delta=\(5, 1\) .*\[5, 3\]"),
        (lambda: rewards.prediction_error(prediction(M, B, O), zeros(B, O), zeros(1)), r"scale=\(1,\) .*\[3\]"),
        (lambda: rewards.trajectory_spread(zeros(B)), r"delta=\(5,\) .*\[N, O\], N and O 1 or more"),
        (lambda: dynamics.model_targets(STATS, zeros(B, 1), zeros(B, O)), r"obs=\(5, 1\) .*\[\.\.\., 3\]"),
        (lambda: dynamics.model_targets(STATS, zeros(B, O), zeros(B, 1)), r"next_obs=\(5, 1\) .*\[\.\.\., 3\]"),
        (lambda: dynamics.apply_delta(STATS, zeros(B, 1), zeros(B, O)), r"obs=\(5, 1\) .*\[\.\.\., 3\]"),
        (lambda: replay.add(replay.init(zeros(O), 9), zeros(B, O), np.ones(1, bool)), r"valid=\(1,\) .*\[5\]"),
        (
            lambda: jx.stein_direction(zeros(M, B, 1), zeros(1, B, 1), jx.SVGDConfig()),
            r"scores=\(4, 5, 1\) .*\[1, n, 1\]",
        ),
        (lambda: of_belief(lambda b, m, s: b.imagine(m, s, zeros(B, 1), zeros(B, A))), r"obs=\(5, 1\) .*\[N, 3\]"),
        (lambda: of_belief(lambda b, m, s: b.imagine(m, s, zeros(B, O), zeros(1, A))), r"action=\(1, 2\) .*\[5, 2\]"),
        (lambda: of_belief(lambda b, m, s: b.predict(m, zeros(B, O))), r"inputs=\(5, 3\) .*\[N, 5\]"),
        (lambda: of_explorer(lambda e, s: e.act(KEY, e.actor(s), zeros(1))), r"obs=\(1,\) .*\[\.\.\., 3\]"),
        (lambda: of_explorer(lambda e, s: e.act_greedily(KEY, e.actor(s), zeros(1))), r"obs=\(1,\)"),
        (lambda: of_explorer(lambda e, s: e.act_uniformly(KEY, zeros(1))), r"obs=\(1,\)"),
        (lambda: of_explorer(lambda e, s: e.observe(s, batch(), np.ones(1, bool))), r"valid=\(1,\) .*\[5\]"),
        (lambda: of_explorer(lambda e, s: e.improve(KEY, s, zeros(1), jnp.int32(B))), r"obs=\(1,\) .*\[3\]"),
        (
            lambda: of_explorer(lambda e, s: e.assess(KEY, s, batch(num=0), np.ones(0, bool))),
            r"transitions\.obs=\(0, 3\) .*\[T, 3\], T 1 or more",
        ),
        (lambda: of_explorer(lambda e, s: e.assess(KEY, s, batch(), np.ones(1, bool))), r"valid=\(1,\) .*\[5\]"),
        (lambda: of_rnd(lambda r, s: r.error(s, zeros(B, 1))), r"obs=\(5, 1\) .*\[\.\.\., 3\]"),
        (lambda: of_rnd(lambda r, s: r.update(s, zeros(B, O), zeros(1))), r"weights=\(1,\) .*\[5\]"),
        (lambda: of_ppo(obs=(B, 1)), r"rollout\.transitions\.obs=\(5, 1\) .*\[T, 3\]"),
        (lambda: of_ppo(action=(1, A)), r"rollout\.transitions\.action=\(1, 2\) .*\[5, 2\]"),
        (lambda: of_ppo(log_prob=(1,)), r"rollout\.log_prob=\(1,\) .*\[5\]"),
    ],
)
def test_other_shapes_are_refused(call, message):
    with pytest.raises(jx.FieldError, match=message):
        call()
