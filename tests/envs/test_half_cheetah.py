import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import half_cheetah
from envs.engines import host as host_engine
from envs.half_cheetah import (
    DT,
    GEARS,
    SPEC,
    TASK_SPEC,
    TRANSFER_SPEC,
    make_half_cheetah,
    make_half_cheetah_task,
    make_half_cheetah_transfer,
    make_model,
)

BATCH = 8


@pytest.fixture(scope="module")
def model():
    return make_model()


@pytest.fixture(scope="module")
def host():
    return make_half_cheetah("mujoco")


@pytest.fixture(scope="module")
def task():
    return make_half_cheetah_task("mujoco")


@pytest.fixture(scope="module")
def transfer():
    return make_half_cheetah_transfer("mujoco")


def host_state(env, qpos, qvel):
    """A host state with these positions `[9]` and velocities `[9]`, at the start of an episode."""
    blank = env.reset(jax.random.key(0))
    physics = np.zeros_like(blank.physics)
    physics[1:10], physics[10:19] = qpos, qvel
    return blank.replace(physics=physics)


def parts(state):
    """qpos `[9]` and qvel `[9]` of a host state."""
    return state.physics[1:10], state.physics[10:19]


class TestModel:
    def test_numbers(self, model):
        assert (model.nq, model.nv, model.nu) == (9, 9, 6)
        assert model.opt.timestep == 0.01
        np.testing.assert_allclose(model.body_mass.sum(), 14, rtol=1e-12)
        np.testing.assert_array_equal(model.actuator_gear[:, 0], [120, 90, 60, 120, 60, 30])
        assert GEARS == (120, 90, 60, 120, 60, 30)
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-1, 1]] * 6)

    @pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass':UserWarning")
    def test_is_gymnasiums(self, model):
        theirs = gymnasium.make("HalfCheetah-v5").unwrapped.model  # type: ignore[attr-defined]
        for name in ("body_mass", "body_inertia", "body_pos", "dof_damping", "dof_armature", "dof_invweight0"):
            np.testing.assert_array_equal(getattr(model, name), getattr(theirs, name), name)
        for name in ("jnt_range", "jnt_stiffness", "geom_friction", "geom_size", "geom_solref", "geom_solimp"):
            np.testing.assert_array_equal(getattr(model, name), getattr(theirs, name), name)

    def test_names_follow_the_model(self, model):
        assert [model.joint(i).name for i in range(3, 9)] == list(half_cheetah.JOINTS)
        assert [model.actuator(i).name for i in range(6)] == list(half_cheetah.JOINTS)
        assert (SPEC.obs_size, SPEC.action_size, SPEC.episode_steps, SPEC.dt) == (19, 6, 100, 0.05)
        assert (TASK_SPEC.obs_size, TASK_SPEC.action_size, TASK_SPEC.episode_steps) == (17, 6, 1000)
        assert len(set(SPEC.obs_names)) == 19 and len(set(TASK_SPEC.obs_names)) == 17
        assert SPEC.obs_names[12] == "pitch rate [rad/s]"

    def test_fewer_solver_iterations_change_no_bit_and_contacts_are_few(self, host, model):
        full = make_model()
        full.opt.iterations, full.opt.ls_iterations = 100, 50
        physics, data = host_engine.make_physics(full, 5), mujoco.MjData(model)
        rng = np.random.default_rng(0)
        for _ in range(10):
            # On its feet, on its back, thrown.
            scale = np.array([0, 0.3, 2, *[0.5] * 6])
            state = host_state(host, rng.uniform(-1.5, 1.5, 9) * scale, rng.normal(0, 3, 9))
            for _ in range(60):
                action = np.sign(rng.uniform(-1, 1, 6)).astype(np.float32)
                expected = physics.step(state.physics, action)
                state, _ = host.step(state, action)
                np.testing.assert_array_equal(state.physics, expected)
                mujoco.mj_setState(model, data, state.physics, host_engine.STATE)
                mujoco.mj_forward(model, data)
                assert data.ncon <= half_cheetah.MAX_CONTACTS

    def test_mjx_looks_for_every_pair_and_keeps_the_deepest(self, model):
        from mujoco.mjx._src import collision_driver

        assert len(list(collision_driver.geom_pairs(model))) == 8  # The floor with every part.
        assert len(collision_driver.make_condim(model)) == half_cheetah.MAX_CONTACTS == 8

    def test_views(self, host):
        assert host.view.cameras == ("track", "side")
        assert envs.make("half_cheetah", backend="mujoco").spec is SPEC
        assert envs.make("half_cheetah_task", backend="mujoco").spec is TASK_SPEC
        assert envs.make("half_cheetah_transfer", backend="mujoco").spec is TRANSFER_SPEC


class TestAgainstGymnasium:
    @pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass':UserWarning")
    def test_an_episode(self, task, host):
        theirs = gymnasium.make("HalfCheetah-v5")
        theirs.reset(seed=0)
        rng = np.random.default_rng(0)
        state = task.reset(jax.random.key(0))
        exploring = host_state(host, *parts(state))
        theirs.unwrapped.set_state(*parts(state))  # type: ignore[attr-defined]
        # Forces held for a while: it runs, falls and lies on its back.
        actions = np.repeat(rng.uniform(-1, 1, (200, 6)), 5, axis=0).astype(np.float32)
        for step, action in enumerate(actions):
            state, got = task.step(state, action)
            obs, reward, terminated, truncated, _ = theirs.step(action)
            np.testing.assert_array_equal(got.next_obs, np.float32(obs))
            np.testing.assert_allclose(got.reward, float(reward), rtol=0, atol=1e-6)
            assert (bool(got.terminated), bool(got.truncated)) == (terminated, truncated) == (False, step == 999)
            before, exploring = parts(exploring)[0], host.step(exploring, action)[0]
            np.testing.assert_array_equal(exploring.physics, state.physics)
            velocity = (parts(state)[0][0] - before[0]) / DT
            np.testing.assert_allclose(exploring.obs[0], velocity, atol=1e-6)

    def test_start_is_gymnasiums_distribution(self):
        qpos, qvel = jax.jit(jax.vmap(half_cheetah.start))(jax.random.split(jax.random.key(0), 4000))
        assert np.abs(qpos).max() <= 0.1
        # Standard errors: 0.1 / sqrt(3) / sqrt(4000) = 0.0009 and 0.1 / sqrt(4000) = 0.0016 of the means.
        np.testing.assert_allclose(qpos.mean(0), 0, atol=0.004)
        np.testing.assert_allclose(qpos.std(0), 0.1 / np.sqrt(3), atol=0.003)
        np.testing.assert_allclose(qvel.mean(0), 0, atol=0.007)
        np.testing.assert_allclose(qvel.std(0), 0.1, atol=0.005)


class TestObservation:
    def test_layout(self, host, task):
        rng = np.random.default_rng(0)
        state, other = host.reset(jax.random.key(0)), task.reset(jax.random.key(0))
        np.testing.assert_array_equal(state.physics, other.physics)
        assert state.obs[0] == 0
        for _ in range(20):
            before, (state, transition) = parts(state)[0], host.step(state, rng.uniform(-1, 1, 6))
            qpos, qvel = parts(state)
            pitch = [np.sin(qpos[2]), np.cos(qpos[2])]
            expected = [(qpos[0] - before[0]) / 0.05, qpos[1], *pitch, *qpos[3:], *qvel]
            np.testing.assert_allclose(transition.next_obs, np.float32(expected), rtol=1e-6)
            assert transition.reward == 0

    def test_somersaults_later_the_same_posture_looks_the_same(self, task, transfer):
        assert (TRANSFER_SPEC.obs_names, TRANSFER_SPEC.episode_steps) == (SPEC.obs_names, 1000)
        assert TRANSFER_SPEC.has_reward and not SPEC.has_reward
        rng = np.random.default_rng(0)
        qpos, qvel = rng.uniform(-0.1, 0.1, 9), rng.normal(0, 3, 9)
        turned = qpos + 6 * np.pi * (np.arange(9) == 2)
        once, later = (host_state(transfer, start, qvel) for start in (qpos, turned))
        plain = host_state(task, turned, qvel)
        for _ in range(5):
            action = rng.uniform(-1, 1, 6)
            (once, first), (later, then), (plain, as_it_is) = (
                env.step(state, action) for env, state in ((transfer, once), (transfer, later), (task, plain))
            )
            np.testing.assert_allclose(first.next_obs, then.next_obs, atol=1e-5)
            angle = as_it_is.next_obs[1]
            assert angle > 5 * np.pi
            expected = [as_it_is.next_obs[0], np.sin(angle), np.cos(angle), *as_it_is.next_obs[2:]]
            np.testing.assert_allclose(then.next_obs[1:], expected, atol=1e-5)
            assert then.reward == as_it_is.reward != 0

    def test_same_key_same_state(self, host):
        first, again, other = (host.reset(jax.random.key(seed)) for seed in (3, 3, 4))
        np.testing.assert_array_equal(first.obs, again.obs)
        assert not np.array_equal(first.obs, other.obs)

    def test_truncated_at_100(self, host):
        state, flags = host.reset(jax.random.key(0)), []
        for _ in range(100):
            state, transition = host.step(state, np.zeros(6))
            flags.append((bool(transition.terminated), bool(transition.truncated)))
        assert flags == [(False, False)] * 99 + [(False, True)]

    def test_noise_and_bad_input(self):
        noisy = make_half_cheetah("mujoco", obs_noise=0.02)
        clean = make_half_cheetah("mujoco").reset(jax.random.key(0))
        assert 0.005 < (noisy.reset(jax.random.key(0)).obs - clean.obs).std() < 0.04
        with pytest.raises(ValueError, match=r"Did you mean 'mjx'\?"):
            make_half_cheetah("mjxx")
        with pytest.raises(ValueError, match=r"action has shape \(5,\). Allowed: \(6,\)"):
            noisy.step(clean, np.zeros(5))


class TestCoverage:
    def test_cells_are_speed_and_pitch_rate(self, host, task, transfer):
        assert host.coverage.num_cells == task.coverage.num_cells == 400
        speed, rate = np.meshgrid(np.arange(-4.75, 5, 0.5), np.arange(-9.5, 10), indexing="ij")
        for env, dims in ((host, (0, 12)), (task, (8, 10)), (transfer, (0, 12))):
            obs = np.zeros((400, env.spec.obs_size), np.float32)
            obs[:, dims[0]], obs[:, dims[1]] = speed.ravel(), rate.ravel()
            np.testing.assert_array_equal(jax.jit(jax.vmap(env.coverage.cell))(obs), np.arange(400))

    def test_beyond_the_grid_is_its_edge(self, host):
        obs = np.zeros((2, 19), np.float32)
        obs[:, 0], obs[:, 12] = (-9, 9), (-99, 99)
        np.testing.assert_array_equal(jax.jit(jax.vmap(host.coverage.cell))(obs), [0, 399])


class TestParity:
    """MJX in float32 against C MuJoCo in float64, from the same numbers. Bounds are a few times what was measured."""

    def test_mjx(self, host):
        device = make_half_cheetah("mjx")
        rng = np.random.default_rng(0)
        states = [host.reset(jax.random.key(seed)) for seed in range(BATCH)]
        for seed, state in enumerate(states):
            qpos, qvel = parts(state)
            # Half of them in the air, two on their back.
            qpos[1] += 0.5 * (seed < 4)
            qpos[2] += np.pi * (seed % 4 == 3)
            states[seed] = host_state(host, np.float32(qpos), np.float32(qvel))
        on_device = jax.jit(jax.vmap(device.reset))(jax.random.split(jax.random.key(0), BATCH))
        qpos, qvel = (jnp.asarray(np.stack(x), jnp.float32) for x in zip(*map(parts, states), strict=True))
        on_device = on_device.replace(physics=on_device.physics.replace(qpos=qpos, qvel=qvel))
        step = jax.jit(jax.vmap(device.step))
        differences = []
        for _ in range(10):
            actions = rng.uniform(-1, 1, (BATCH, 6)).astype(np.float32)
            on_device, got = step(on_device, actions)
            pairs = [host.step(state, action) for state, action in zip(states, actions, strict=True)]
            states = [state for state, _ in pairs]
            difference = np.abs(got.next_obs - np.stack([want.next_obs for _, want in pairs]))
            differences.append((difference[:, 1:10].max(), np.delete(difference, np.s_[1:10], axis=1).max()))
        positions, velocities = np.array(differences).T
        assert positions[0] < 3e-6 and velocities[0] < 5e-5, (positions[0], velocities[0])
        assert positions.max() < 2e-4 and velocities.max() < 5e-3, (positions, velocities)
