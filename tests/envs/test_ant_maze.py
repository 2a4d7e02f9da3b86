import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import ant_maze, coverage
from envs.ant_maze import SIDES, SPEC, WALLS, make_ant_maze, make_model
from envs.base import EnvState
from envs.engines import host as host_engine

CENTRES = np.array([(0, 0), (2, 0), (4, 0), (4, 2), (4, 4), (2, 4), (0, 4)], float)
BLOCKS = [(x, y) for x in (-2, 0, 2, 4, 6) for y in (-2, 0, 2, 4, 6)]
BATCH = 8
STANDING = np.array([0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1])
"""Knees bent into their range; the feet nearly touch the floor."""


@pytest.fixture(scope="module")
def model():
    return make_model()


@pytest.fixture(scope="module")
def host():
    return make_ant_maze("mujoco")


@pytest.fixture(scope="module")
def device():
    return make_ant_maze("mjx")


@pytest.fixture(scope="module")
def starts():
    """qpos `[4000, 15]` and qvel `[4000, 14]` of that many starts."""
    return jax.device_get(jax.jit(jax.vmap(ant_maze.start))(jax.random.split(jax.random.key(0), 4000)))


@pytest.fixture(scope="module")
def device_step(device):
    """The one MJX program of these tests: `BATCH` ants take a step. It is traced once."""
    traces = []

    def step(state, action):
        traces.append(action)
        return device.step(state, action)

    yield jax.jit(jax.vmap(step))
    assert len(traces) == 1


@pytest.fixture(scope="module")
def device_start(device):
    """`BATCH` ants on the device, at their starts."""
    return jax.jit(jax.vmap(device.reset))(jax.random.split(jax.random.key(0), BATCH))


def host_states(host, qpos, qvel=None):
    """One host state for each row of `qpos` `[B, 15]` and `qvel` `[B, 14]`."""
    blank, states = host.reset(jax.random.key(0)), []
    for i, row in enumerate(qpos):
        physics = np.zeros_like(blank.physics)
        physics[1:16] = np.float32(row)
        physics[16:30] = 0 if qvel is None else np.float32(qvel[i])
        states.append(blank.replace(physics=physics))
    return states


def device_states(device_start, states):
    """The same states on the device, stacked."""
    physics = jnp.asarray(np.stack([state.physics for state in states]), jnp.float32)
    return device_start.replace(physics=device_start.physics.replace(qpos=physics[:, 1:16], qvel=physics[:, 16:30]))


def contacts(model, state):
    """MuJoCo's data with the contacts of a host state."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state.physics, host_engine.STATE)
    mujoco.mj_forward(model, data)
    return data


def compare(host, device_start, device_step, states, actions):
    """Steps both engines through `actions` `[T, B, 8]`. Largest differences in qpos and in the velocities, `[T]`."""
    on_device, qpos, velocities = device_states(device_start, states), [], []
    for action in actions:
        on_device, got = device_step(on_device, np.float32(action))
        pairs = [host.step(state, a) for state, a in zip(states, action, strict=True)]
        states = [state for state, _ in pairs]
        difference = np.abs(got.next_obs - np.stack([want.next_obs for _, want in pairs]))
        qpos.append(difference[:, 2:17].max())
        velocities.append(np.delete(difference, np.s_[2:17], axis=1).max())
    return np.array(qpos), np.array(velocities), states


class TestModel:
    def test_max_numbers(self, model):
        assert model.opt.timestep == 0.01
        assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        assert (model.nq, model.nv, model.nu) == (15, 14, 8)
        np.testing.assert_array_equal(model.actuator_gear[:, 0], 150)
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-1, 1]] * 8)
        assert np.all(model.geom_condim == 3)
        np.testing.assert_array_equal(model.geom_friction, [[1, 0.5, 0.5]] * model.ngeom)
        torso = model.body("torso").id
        # Density 5: a sphere of radius 0.25 and four capsules of radius 0.08, length 0.2 sqrt(2).
        capsule = np.pi * 0.08**2 * 0.2 * np.sqrt(2) + 4 / 3 * np.pi * 0.08**3
        np.testing.assert_allclose(model.body_mass[torso], 5 * 4 / 3 * np.pi * 0.25**3, rtol=1e-6)
        np.testing.assert_allclose(model.body_mass[torso + 1], 5 * capsule, rtol=1e-6)
        np.testing.assert_array_equal(model.qpos0[:7], [0, 0, 0.75, 1, 0, 0, 0])

    def test_names_follow_the_model(self, model):
        joints = [model.joint(i).name for i in range(1, model.njnt)]
        assert joints == list(ant_maze.JOINTS)
        assert [model.actuator(i).name for i in range(model.nu)] == list(ant_maze.ACTUATORS)
        assert ant_maze.ACTUATORS[:3] == ("hip_4", "ankle_4", "hip_1")
        assert (SPEC.obs_size, SPEC.action_size, SPEC.episode_steps, SPEC.dt) == (31, 8, 300, 0.05)
        assert len(set(SPEC.obs_names)) == 31
        assert SPEC.obs_names[2:4] == ("x [m]", "y [m]")

    def test_mjx_looks_for_every_pair_and_keeps_the_deepest(self, model):
        from mujoco.mjx._src import collision_driver

        assert len(list(collision_driver.geom_pairs(model))) == 13 * 6  # floor, four sides, inner wall
        assert len(collision_driver.make_condim(model)) == ant_maze.MAX_CONTACTS == 24

    def test_fewer_solver_iterations_change_no_bit(self, host):
        full = make_model()
        full.opt.iterations, full.opt.ls_iterations = 100, 50
        physics = host_engine.make_physics(full, 5)
        state, rng = host.reset(jax.random.key(0)), np.random.default_rng(0)
        for _ in range(300):
            action = rng.uniform(-1, 1, 8).astype(np.float32)
            expected = physics.step(state.physics, action)
            state, _ = host.step(state, action)
            np.testing.assert_array_equal(state.physics, expected)

    def test_cameras_for_videos(self, model):
        assert model.camera("overview").id >= 0
        assert model.camera("track").id >= 0

    @pytest.mark.parametrize("camera", ["track", "overview"])
    def test_no_wall_hides_the_ant(self, model, host, camera):
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        boxes = [model.site(f"wall_{index}") for index in range(len(WALLS))]
        low = np.array([box.pos - box.size for box in boxes])
        high = np.array([box.pos + box.size for box in boxes])
        np.testing.assert_allclose(np.concatenate([low[:, :2], high[:, :2]], axis=1), WALLS)
        assert all(model.geom(f"{kind}_{i}").rgba[3] == 0 for kind, n in (("wall", 5), ("side", 4)) for i in range(n))
        ant = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] != 0]
        for cell in range(7):
            state = host.reset_in(jax.random.key(cell), cell)
            action = rng.uniform(-1, 1, 8).astype(np.float32)
            for step in range(60):
                if step % 5 == 0:
                    action = rng.uniform(-1, 1, 8).astype(np.float32)
                state, _ = host.step(state, action)
                mujoco.mj_setState(model, data, state.physics, host_engine.STATE)
                mujoco.mj_forward(model, data)
                eye = data.camera(camera).xpos
                # Both ends of every capsule; the torso has none.
                axes = data.geom_xmat[ant].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[ant, 1:2]
                ends = np.concatenate([data.geom_xpos[ant] + axes, data.geom_xpos[ant] - axes])
                rays = (ends - eye)[:, None]
                # Where a line of sight enters and leaves each box, 0 at the eye and 1 at the ant.
                faces = np.sort(np.stack([(low - eye) / rays, (high - eye) / rays]), axis=0)
                enter, leave = faces[0].max(axis=-1), faces[1].min(axis=-1)
                assert not np.any((enter < leave) & (leave > 0) & (enter < 1)), (cell, step)

    def test_every_part_of_the_ant_meets_the_floor_and_every_wall(self, model):
        data = mujoco.MjData(model)
        ant = [i for i in range(model.ngeom) if model.geom_bodyid[i] != 0]
        assert len(ant) == 13
        # The ant rides level at z = 1; its part's centre is put on the surface.
        surfaces = {f"side_{i}": (np.array(pos, float), np.array([0, 0, 0])) for i, (pos, _) in enumerate(SIDES)}
        targets = {name: (pos + np.where(pos == 0, 2.0, 0.0))[:2] for name, (pos, _) in surfaces.items()}
        targets["wall_4"] = np.array([1.0, 1.0])
        for geom in ant:
            for name, target in targets.items():
                mujoco.mj_resetData(model, data)
                data.qpos[2] = 1.0
                mujoco.mj_kinematics(model, data)
                data.qpos[:2] += target - data.geom_xpos[geom, :2]
                mujoco.mj_forward(model, data)
                assert {geom, model.geom(name).id} in [set(pair) for pair in data.contact.geom.tolist()], name
            mujoco.mj_resetData(model, data)
            mujoco.mj_kinematics(model, data)
            data.qpos[2] -= data.geom_xpos[geom, 2]
            mujoco.mj_forward(model, data)
            assert {geom, 0} in [set(pair) for pair in data.contact.geom.tolist()]

    def test_the_ants_own_parts_do_not_touch(self, model):
        data = mujoco.MjData(model)
        data.qpos[7:] = np.random.default_rng(0).uniform(-3, 3, 8)
        mujoco.mj_forward(model, data)
        assert all(0 in model.geom_bodyid[pair] for pair in data.contact.geom)


class TestWalls:
    def test_floor_plan_blocks_18_of_25_blocks(self, host):
        plan = host.floor_plan
        for x, y in BLOCKS:
            blocked = any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in plan.walls)
            assert blocked == ((x, y) not in CENTRES.tolist() and [x, y] not in CENTRES.tolist())
        area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in (*plan.walls, *plan.cells))
        assert area == 100  # 10 m x 10 m, nothing twice and nothing left out
        assert plan.position == (2, 3)
        np.testing.assert_array_equal([((a + c) / 2, (b + d) / 2) for a, b, c, d in plan.cells], CENTRES)

    @pytest.mark.parametrize("height", [0.3, 1.0, 3.0, 5.9])
    def test_what_the_ant_can_touch_blocks_the_same(self, model, height):
        for x, y in BLOCKS:
            for dx in (-0.95, 0.0, 0.95):
                for dy in (-0.95, 0.0, 0.95):
                    point = np.array([x + dx, y + dy, height])
                    outside = any(np.dot(point - pos, normal) < 0 for pos, normal in SIDES)
                    wall = model.geom("wall_4").id
                    inside = np.all(np.abs(point - model.geom_pos[wall]) < model.geom_size[wall])
                    assert (outside or inside) == ([x, y] not in CENTRES.tolist())

    def test_sides_are_the_inner_faces_of_the_outer_walls(self, model):
        for index, (pos, normal) in enumerate(SIDES):
            axis = int(np.argmax(np.abs(normal)))
            wall = np.array(WALLS[index]).reshape(2, 2)[:, axis]
            assert pos[axis] == (wall[1] if normal[axis] > 0 else wall[0])
            geom = model.geom(f"side_{index}")
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, geom.quat)
            np.testing.assert_allclose(rotation.reshape(3, 3)[:, 2], normal, atol=1e-12)

    def test_boxes_of_the_model_are_the_floor_plan(self, model):
        for index, (x0, y0, x1, y1) in enumerate(WALLS):
            geom = model.geom(f"wall_{index}")
            np.testing.assert_allclose(geom.pos - geom.size, [x0, y0, 0])
            np.testing.assert_allclose(geom.pos + geom.size, [x1, y1, 6])

    @pytest.mark.parametrize("cell", range(7))
    def test_no_ant_leaves_the_maze(self, host, model, cell):
        rng = np.random.default_rng(cell)
        qpos, qvel = model.qpos0.copy(), np.zeros(14)
        qpos[:2] = CENTRES[cell]
        angle = rng.uniform(0, 2 * np.pi)
        qvel[:2] = 10 * np.cos(angle), 10 * np.sin(angle)
        (state,) = host_states(host, [qpos], [qvel])
        ant, seen = model.geom_bodyid != 0, []
        for _ in range(300):
            state, transition = host.step(state, np.sign(rng.uniform(-1, 1, 8)))
            seen.append(transition.next_obs)
            data = contacts(model, state)
            # The axis of no part is inside a wall; parts are at least 0.08 m thick.
            assert np.all((data.geom_xpos[ant, :2] > -1) & (data.geom_xpos[ant, :2] < 5))
            assert data.contact.dist.min(initial=0) > -0.16
            assert 0 < transition.next_obs[4] < 6
        assert (jax.vmap(host.coverage.cell)(jnp.stack(seen)) >= 0).all()
        assert not transition.terminated


class TestObservation:
    def test_layout(self, host):
        state = host.reset(jax.random.key(0))
        np.testing.assert_array_equal(state.obs[:2], 0)
        rng = np.random.default_rng(0)
        for _ in range(20):
            before = state
            state, transition = host.step(state, rng.uniform(-1, 1, 8))
            qpos, qvel = state.physics[1:16], state.physics[16:30]
            np.testing.assert_array_equal(transition.next_obs[2:17], np.float32(qpos))
            np.testing.assert_array_equal(transition.next_obs[17:], np.float32(qvel))
            velocity = (qpos[:2] - before.physics[1:3]) / 0.05
            np.testing.assert_array_equal(transition.next_obs[:2], np.float32(velocity))
            np.testing.assert_array_equal(transition.obs, before.obs)
            np.testing.assert_array_equal(transition.next_obs, state.obs)
            assert transition.reward == 0

    def test_every_episode_begins_in_the_start_cell(self, host, starts):
        obs = np.zeros((len(starts[0]), 31), np.float32)
        obs[:, 2:4] = starts[0][:, :2]
        visited = coverage.update_from_obs(host.coverage, coverage.init(host.coverage), obs)
        np.testing.assert_array_equal(visited, [True] + [False] * 6)


class TestReset:
    def test_same_key_same_state(self, host):
        first, again, other = (host.reset(jax.random.key(seed)) for seed in (3, 3, 4))
        np.testing.assert_array_equal(first.physics, again.physics)
        np.testing.assert_array_equal(first.obs, again.obs)
        assert not np.array_equal(first.obs, other.obs)

    def test_engines_start_alike(self, host, device):
        reset = jax.jit(device.reset)
        for seed in range(3):
            on_host, on_device = host.reset(jax.random.key(seed)), reset(jax.random.key(seed))
            np.testing.assert_allclose(on_device.obs, on_host.obs, rtol=0, atol=1e-7)
            np.testing.assert_allclose(on_device.physics.qpos, on_host.physics[1:16], rtol=0, atol=1e-7)
            np.testing.assert_allclose(on_device.physics.qvel, on_host.physics[16:30], rtol=0, atol=1e-7)
            assert on_host.num_steps == on_device.num_steps == 0

    def test_distribution(self, starts):
        qpos, qvel = starts
        # Positions and joints are uniform in 0.1 around qpos0, deviation 0.1 / sqrt(3); standard errors below 0.001.
        rest = np.array([0, 0, 0.75, *[0] * 8])
        free = np.delete(np.asarray(qpos), np.s_[3:7], axis=1) - rest
        assert np.abs(free).max() <= 0.1 + 1e-6
        np.testing.assert_allclose(free.mean(0), 0, atol=0.004)
        np.testing.assert_allclose(free.std(0), 0.1 / np.sqrt(3), atol=0.003)
        np.testing.assert_allclose(qvel.mean(0), 0, atol=0.007)
        np.testing.assert_allclose(qvel.std(0), 0.1, atol=0.005)
        np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-6)
        assert np.abs(qpos[:, 4:7]).max() <= 0.1 / 0.9
        together = np.concatenate([np.asarray(qpos), np.asarray(qvel)], axis=1)
        correlation = np.corrcoef(np.delete(together, 3, axis=1).T) - np.eye(28)
        assert np.abs(correlation).max() < 5 / np.sqrt(4000)


class TestEpisode:
    def test_truncated_at_300_and_never_terminated(self, host):
        state, rng = host.reset(jax.random.key(0)), np.random.default_rng(0)
        flags = []
        for _ in range(301):
            state, transition = host.step(state, rng.uniform(-1, 1, 8))
            flags.append((bool(transition.terminated), bool(transition.truncated)))
        assert flags[:299] == [(False, False)] * 299
        assert flags[299:] == [(False, True)] * 2

    @pytest.mark.slow
    def test_device_counts_alike(self, device_start, device_step):
        states = device_start.replace(num_steps=jnp.arange(295, 303, dtype=jnp.int32))
        states, transitions = device_step(states, jnp.zeros((BATCH, 8)))
        np.testing.assert_array_equal(transitions.truncated, np.arange(296, 304) >= 300)
        assert not transitions.terminated.any()
        np.testing.assert_array_equal(states.num_steps, np.arange(296, 304))

    def test_a_saved_host_state_continues_to_the_bit(self, host):
        state, rng = host.reset(jax.random.key(0)), np.random.default_rng(0)
        actions = rng.uniform(-1, 1, (60, 8))
        for action in actions[:30]:
            state, _ = host.step(state, action)
        saved, frozen = state, state.physics.copy()

        def follow(env, state):
            steps = []
            for action in actions[30:]:
                state, transition = env.step(state, action)
                steps.append(transition.next_obs)
            return np.array(steps), state.physics

        first = follow(host, saved)
        for i in range(40):  # elsewhere, so that what is left in the engine differs
            host.step(host.reset(jax.random.key(i)), actions[i])
        for env in (host, make_ant_maze("mujoco")):
            for a, b in zip(first, follow(env, saved), strict=True):
                np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(saved.physics, frozen)

    @pytest.mark.slow
    def test_a_saved_device_state_continues_to_the_bit(self, device_start, device_step):
        states = device_start
        actions = np.random.default_rng(0).uniform(-1, 1, (12, BATCH, 8)).astype(np.float32)
        for action in actions[:6]:
            states, _ = device_step(states, action)
        leaves, tree = jax.tree.flatten(states.replace(key=jax.random.key_data(states.key)))
        saved = [np.array(leaf) for leaf in leaves]
        restored: EnvState = jax.tree.unflatten(tree, [jnp.asarray(leaf) for leaf in saved])
        restored = restored.replace(key=jax.random.wrap_key_data(restored.key))
        for action in actions[6:]:
            states, first = device_step(states, action)
            restored, again = device_step(restored, action)
            jax.tree.map(np.testing.assert_array_equal, first, again)


class TestParity:
    """MJX in float32 against C MuJoCo in float64, from the same numbers. Bounds are a few times what was measured."""

    def test_in_the_air(self, host, device_start, device_step):
        rng = np.random.default_rng(0)
        qpos = np.tile(STANDING, (BATCH, 1))
        qpos[:, :3] = 2, 2, 40  # Above the inner wall and far from the others; 2.5 s are 30 m down.
        qpos[:, 7:] += rng.uniform(-0.2, 0.2, (BATCH, 8))
        states = host_states(host, qpos, rng.normal(0, 0.1, (BATCH, 14)))
        actions = 0.02 * rng.uniform(-1, 1, (50, BATCH, 8))  # Gentle: joint limits are met at a moment, and amplify.
        differences = compare(host, device_start, device_step, states, actions)
        assert_close(differences, first=(2e-5, 5e-5), last=(2e-4, 5e-4))

    def test_standing_on_the_floor(self, host, device_start, device_step, model):
        qpos = np.tile(STANDING, (BATCH, 1))
        qpos[:7, :2] = CENTRES
        states = host_states(host, qpos)
        *differences, states = compare(host, device_start, device_step, states, np.zeros((50, BATCH, 8)))
        assert all(contacts(model, state).ncon >= 4 for state in states)
        assert_close(differences, first=(1e-6, 1e-5), last=(5e-6, 5e-5))

    def test_against_the_walls(self, host, device_start, device_step, model):
        # Into each outer wall, and into the inner one from the south, the north, its end and at a slant.
        places = [(-0.3, 0), (4.3, 0), (0, -0.3), (0, 4.3), (0, 0.3), (2, 3.7), (3.7, 2), (0, -0.3)]
        towards = [(-1, 0), (1, 0), (0, -1), (0, 1), (0, 1), (0, -1), (-1, 0), (0.3, -1)]
        names = ["side_0", "side_1", "side_2", "side_3", "wall_4", "wall_4", "wall_4", "side_2"]
        qpos, qvel = np.tile(STANDING, (BATCH, 1)), np.zeros((BATCH, 14))
        qpos[:, :2], qvel[:, :2] = places, towards
        states = host_states(host, qpos, qvel)
        touched = [host.step(state, np.zeros(8))[0] for state in states]
        for state, name in zip(touched, names, strict=True):
            assert model.geom(name).id in contacts(model, state).contact.geom
        differences = compare(host, device_start, device_step, states, np.zeros((50, BATCH, 8)))
        assert_close(differences, first=(5e-6, 5e-5), last=(5e-4, 5e-4))


@pytest.mark.gpu
class TestParityOnTheGPU(TestParity):
    """The same where JAX's own device is a GPU, whose matrix products need not have float32's digits."""


def assert_close(differences, first, last):
    """Bounds `(qpos, velocities)` on what `compare` gives, for one step and for all of them."""
    qpos, velocities = differences[:2]
    assert (qpos[0] < first[0], velocities[0] < first[1]) == (True, True), (qpos[0], velocities[0])
    assert (qpos.max() < last[0], velocities.max() < last[1]) == (True, True), (qpos.max(), velocities.max())


class TestOptions:
    def test_noise_shifts_the_start_but_not_the_state(self, host):
        noisy = make_ant_maze("mujoco", obs_noise=0.02)
        clean_state, noisy_state = host.reset(jax.random.key(0)), noisy.reset(jax.random.key(0))
        np.testing.assert_array_equal(clean_state.physics, noisy_state.physics)
        difference = noisy_state.obs - clean_state.obs
        assert 0.01 < difference.std() < 0.03
        assert np.all(difference != 0)

    def test_unknown_backend(self):
        with pytest.raises(ValueError, match=r"backend='mujco' .*Did you mean 'mujoco'\?"):
            make_ant_maze("mujco")

    @pytest.mark.parametrize("value", [-1.0, float("nan")])
    def test_bad_noise(self, value):
        with pytest.raises(ValueError, match=r"obs_noise=.* is out of range"):
            make_ant_maze("mujoco", obs_noise=value)

    def test_bad_action(self, host):
        state = host.reset(jax.random.key(0))
        with pytest.raises(ValueError, match=r"action has shape \(7,\). Allowed: \(8,\)"):
            host.step(state, np.zeros(7))
        with pytest.raises(ValueError, match="Allowed: finite numbers"):
            host.step(state, np.full(8, np.nan))
