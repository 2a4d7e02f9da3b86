import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

import envs
from envs.adapters.to_gymnasium import GymnasiumEnv, gymnasium_id
from envs.functional import Rules, make_environment
from envs.views import make_sketch_view

NAMES = {
    "ant_maze": "jaxplore/AntMaze-v0",
    "half_cheetah": "jaxplore/HalfCheetah-v0",
    "half_cheetah_transfer": "jaxplore/HalfCheetahTransfer-v0",
    "hand_block": "jaxplore/HandBlock-v0",
    "acrobot": "jaxplore/Acrobot-v0",
    "mountain_car": "jaxplore/MountainCar-v0",
    "nchain": "jaxplore/NChain-v0",
}


def on_host(name):
    """Options with which nothing of MJX is compiled, whatever JAX runs on."""
    return {"backend": "mujoco"} if "mujoco" in envs.backends(name) else {}


def test_every_environment_of_ours_has_an_id():
    assert {name: gymnasium_id(name) for name in NAMES} == NAMES
    for name in envs.FACTORIES:
        assert gymnasium_id(name) in gymnasium.registry


@pytest.mark.parametrize("name", envs.FACTORIES)
def test_passes_gymnasiums_own_checks(name):
    try:
        spec = envs.make(name, **on_host(name)).spec
    except ImportError as error:
        pytest.skip(str(error))
    assert spec.name == name
    env = gymnasium.make(gymnasium_id(name), disable_env_checker=True, **on_host(name))
    with warnings.catch_warnings():
        # Advice on limits and scale, which ours do not follow: the numbers are what they are.
        warnings.filterwarnings("ignore", r".*(observation|action) space (minimum|maximum) value is", UserWarning)
        warnings.filterwarnings("ignore", ".*we recommend using a symmetric and normalized space", UserWarning)
        check_env(env.unwrapped, skip_render_check=True)
    assert isinstance(env.action_space, spaces.Discrete) == spec.discrete
    assert isinstance(env.observation_space, spaces.Discrete) == spec.one_hot_obs
    assert env.observation_space.shape == (() if spec.one_hot_obs else (spec.obs_size,))
    env.close()


def test_a_seed_gives_the_episode_again_and_the_steps_are_the_environments_own():
    env, own = gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco"), envs.make("ant_maze", backend="mujoco")
    runs = []
    for _ in range(2):
        obs, info = env.reset(seed=4)
        env.action_space.seed(4)
        assert info == {"coverage_cell": 0}
        runs.append([obs, *(env.step(env.action_space.sample())[0] for _ in range(5))])
    np.testing.assert_array_equal(*runs)
    key = jax.random.key(int(np.random.Generator(np.random.PCG64(4)).integers(2**31)))
    state = own.reset(key)
    np.testing.assert_array_equal(state.obs, runs[0][0])
    env.action_space.seed(4)
    for expected in runs[0][1:]:
        state, _ = own.step(state, env.action_space.sample())
        np.testing.assert_array_equal(state.obs, expected)
    assert not np.array_equal(env.reset()[0], env.reset()[0])


def make_async(context, **options):
    """Two chains in processes of their own, which start as `context` says."""
    return gymnasium.make_vec(
        "jaxplore/NChain-v0", 2, vectorization_mode="async", vector_kwargs={"context": context}, **options
    )


@pytest.mark.filterwarnings("ignore")  # JAX's own of the fork, and what Gymnasium says of a worker that fails.
def test_a_forked_process_is_refused_and_does_not_hang():
    vector = make_async("fork")
    with pytest.raises(RuntimeError, match=r"forked from one that runs JAX.*Allowed: .*{'context': 'spawn'}\.$"):
        vector.reset(seed=0)
    vector.close(terminate=True)


@pytest.mark.slow
def test_spawned_processes_give_the_numbers_of_this_one():
    vectors = make_async("spawn"), gymnasium.make_vec("jaxplore/NChain-v0", 2, vectorization_mode="sync")
    vectors[0].action_space.seed(0)
    actions = [vectors[0].action_space.sample() for _ in range(10)]
    walks = [[vector.reset(seed=3)[0], *(vector.step(action)[0] for action in actions)] for vector in vectors]
    np.testing.assert_array_equal(*walks)
    for vector in vectors:
        vector.close()


def make_counter(backend="auto", obs_noise=0.0):
    """Two choices, one of which counts up; ends at 3, is cut after 4 steps; a picture as bright as the count."""
    import jax.numpy as jnp

    def draw(axes, state):
        axes.figure.set_facecolor(str(float(state.physics) / 4))

    return make_environment(
        Rules(
            spec=envs.EnvSpec("counter", tuple("0123"), ("stay", "up"), 4, 0.5, discrete=True, one_hot_obs=True),
            start=lambda key: jnp.int32(0),
            advance=lambda key, count, action: count + action[1].astype(jnp.int32),
            observe=lambda before, count: jax.nn.one_hot(count, 4),
            coverage=envs.Coverage(4, lambda obs: jnp.argmax(obs).astype(jnp.int32), "counts"),
            reward=lambda before, action, after: 0.5 * action[1],
            terminated=lambda count: count >= 3,
            view=make_sketch_view((0, 1, 0, 1), draw),
        ),
        obs_noise,
    )


@pytest.fixture
def counter(monkeypatch):
    monkeypatch.setitem(envs.FACTORIES, "counter", make_counter)
    return "counter"


def test_ends_rewards_and_cells(counter):
    env = GymnasiumEnv(counter)
    assert env.observation_space == spaces.Discrete(4)
    assert env.action_space == spaces.Discrete(2)
    assert env.reset(seed=0) == (0, {"coverage_cell": 0})
    told = [env.step(action) for action in (1, 1, 1)]
    assert told == [(i, 0.5, i == 3, False, {"coverage_cell": i}) for i in (1, 2, 3)]
    env.reset()
    told = [env.step(action)[:4] for action in (0, 1, 0, 0)]
    assert told == [(0, 0.0, False, False), (1, 0.5, False, False), (1, 0.0, False, False), (1, 0.0, False, True)]


def test_pictures_show_the_present_state(counter):
    env = GymnasiumEnv(counter, render_mode="rgb_array", height=20, width=30)
    with pytest.raises(ValueError, match="render was called before reset"):
        env.render()
    env.reset(seed=0)
    pictures = [env.render(), env.step(1) and env.render(), env.render(), env.reset() and env.render()]
    assert [picture.shape for picture in pictures if picture is not None] == [(20, 30, 3)] * 4
    brightness = [picture.mean() for picture in pictures if picture is not None]
    np.testing.assert_allclose(brightness, [0, 255 / 4, 255 / 4, 0], atol=1)
    env.close()


def test_refusals(counter):
    with pytest.raises(ValueError, match=r"render_mode='human' is not known\. Allowed: rgb_array"):
        GymnasiumEnv(counter, render_mode="human")
    with pytest.raises(ValueError, match=r"option of 'counter'='noise' is not known\. Did you mean 'obs_noise'"):
        GymnasiumEnv(counter, noise=1)
    env = GymnasiumEnv(counter)
    with pytest.raises(ValueError, match="step was called before reset"):
        env.step(0)
    env.reset()
    with pytest.raises(ValueError, match=r"action is 2\. Allowed: Discrete\(2\)"):
        env.step(2)
    assert env.render() is None
