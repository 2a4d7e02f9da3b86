import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import envs
from envs import hand_block
from envs.hand_block import SPEC, euler_angles, make_hand_block, make_model, make_rotation_coverage

needs_hand = pytest.mark.skipif(
    importlib.util.find_spec("gymnasium_robotics") is None, reason="needs gymnasium-robotics: the extra `robotics`"
)
COVERAGE = make_rotation_coverage()


def cells(quaternions):
    """The cell of each row `(w, x, y, z)`, put at the end of an observation of zeros."""
    quaternions = jnp.asarray(quaternions, jnp.float32)
    obs = jnp.zeros((len(quaternions), 61)).at[:, -4:].set(quaternions)
    return np.asarray(jax.jit(jax.vmap(COVERAGE.cell))(obs))


def scipy_cells(quaternions):
    """The paper's cells, by scipy: `-1` where rounding may put an angle on either side of a border."""
    angles = Rotation.from_quat(np.float32(quaternions)).as_euler("xyz", degrees=True)
    borders = np.array([-180, -136, -91, -46, -1, 45, 90, 135, 180])
    near = (np.abs(angles[..., None] - borders) < 1e-3).any(axis=(1, 2))
    bins = (np.trunc(angles).astype(int) + 180) // 45
    return np.where(near, -1, bins @ [64, 8, 1])


class TestCoverage:
    def test_random_rotations_lie_in_scipys_cells(self):
        quaternions = np.random.default_rng(0).normal(size=(20_000, 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        got, want = cells(quaternions), scipy_cells(quaternions)
        assert (want < 0).mean() < 1e-3
        np.testing.assert_array_equal(got[want >= 0], want[want >= 0])
        assert set(got) == {
            first * 64 + middle * 8 + last for first in range(8) for middle in range(2, 6) for last in range(8)
        }
        assert (COVERAGE.num_cells, COVERAGE.reachable) == (512, 256)

    def test_angles_are_scipys(self):
        quaternions = np.float32(np.random.default_rng(1).normal(size=(5_000, 4)))
        want = Rotation.from_quat(quaternions).as_euler("xyz", degrees=True)
        difference = np.abs(jax.jit(jax.vmap(euler_angles))(quaternions) - want)
        assert np.minimum(difference, 360 - difference).max() < 1e-3

    @pytest.mark.parametrize("angles", [(0, 90, 0), (70, 90, 20), (0, -90, 0), (200, -90, 30), (-100, 90, 100)])
    def test_gimbal_lock(self, angles):
        # The sum or difference of the outer angles is all that can be told: the third is 0, and the cell one of 256.
        exact = Rotation.from_euler("xyz", angles, degrees=True)
        (cell,) = cells([exact.as_quat()])
        assert cell // 8 % 8 == (5 if angles[1] > 0 else 2)
        found = Rotation.from_euler("xyz", jax.jit(euler_angles)(np.float32(exact.as_quat())), degrees=True)
        assert (found * exact.inv()).magnitude() < 1e-3

    def test_half_turns_count_as_minus_180(self):
        half_turns = np.eye(4)  # Read as (x, y, z, w): a half turn about each axis, and none.
        expected = [(0, 4, 4), (0, 4, 0), (4, 4, 0), (4, 4, 4)]
        got = cells(np.concatenate([half_turns, -half_turns]))
        np.testing.assert_array_equal(got, np.array(expected * 2) @ [64, 8, 1])

    def test_total(self):
        grid = np.stack(np.meshgrid(*[[-1.0, -0.5, 0.0, 0.5, 1.0]] * 4), axis=-1).reshape(-1, 4)
        grid = grid[np.any(grid != 0, axis=1)]
        got = cells(grid)
        assert ((got >= 0) & (got < 512)).all()
        assert set(got // 8 % 8) <= {2, 3, 4, 5}

    def test_length_and_sign_do_not_matter(self):
        quaternions = np.random.default_rng(2).normal(size=(2_000, 4))
        known = scipy_cells(quaternions) >= 0
        for factor in (1e-3, 1e3, -1.0):
            np.testing.assert_array_equal(cells(factor * quaternions)[known], cells(quaternions)[known])

    def test_no_rotation_no_cell(self):
        np.testing.assert_array_equal(cells([[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]]), -1)

    def test_borders_are_whole_degrees(self):
        # Read as (x, y, z, w), these turn about x alone. -45.5 is cut to -45, and so lies in the bin from -45 on.
        degrees = [-136.5, -135.5, -91.5, -90.5, -45.5, -0.5, 0.5, 44.9, 45.1, 179.9]
        turned = Rotation.from_euler("x", np.array(degrees)[:, None], degrees=True).as_quat()
        np.testing.assert_array_equal(cells(turned) // 64, [0, 1, 1, 2, 3, 4, 4, 4, 5, 7])


def test_without_the_package_its_extra_is_named(monkeypatch):
    monkeypatch.setattr(hand_block, "PACKAGE", "gymnasium_robotics_that_is_not_there")
    with pytest.raises(ImportError, match=r'pip install -e "\.\[robotics\]"'):
        make_hand_block()


@pytest.fixture(scope="module")
def model():
    return make_model()


@pytest.fixture(scope="module")
def host():
    return make_hand_block()


@needs_hand
class TestModel:
    def test_numbers(self, model):
        assert (model.nq, model.nv, model.nu, model.ntendon, model.npair) == (31, 30, 20, 4, 19)
        assert model.opt.timestep * hand_block.FRAME_SKIP == pytest.approx(0.04)
        np.testing.assert_allclose(model.body("object").mass, 0.05**3 * 567)
        assert (SPEC.obs_size, SPEC.action_size, SPEC.episode_steps, SPEC.dt) == (61, 20, 300, 0.04)
        assert len(set(SPEC.obs_names)) == 61
        assert [int(kind) for kind in model.jnt_type] == [3] * 24 + [0]

    def test_names_follow_the_model(self, model):
        joints = [model.joint(i).name for i in range(24)]
        assert joints == [f"robot0:{joint}" for joint in hand_block.JOINTS]
        servos = [model.actuator(i).name.removeprefix("robot0:A_") for i in range(20)]
        assert SPEC.action_names == tuple(f"{joint} target, of its range" for joint in servos)

    def test_tendons_that_are_left_out_never_pull(self, model):
        whole = mujoco.MjModel.from_xml_path(str(hand_block.find_asset()))
        kept = {model.tendon(i).name for i in range(model.ntendon)}
        for index in range(whole.ntendon):
            first, count = whole.tendon_adr[index], whole.tendon_num[index]
            joints, factors = whole.wrap_objid[first : first + count], whole.wrap_prm[first : first + count]
            ends = np.sort(whole.jnt_range[joints] * factors[:, None], axis=1).sum(axis=0)
            low, high = whole.tendon_range[index]
            assert (low < ends[0] and ends[1] < high) == (whole.tendon(index).name not in kept)

    def test_hand_reaches_no_floor(self, model):
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        hand = [i for i in range(model.ngeom) if model.geom(i).name.startswith("robot0:C_")]
        for _ in range(1_000):
            low, high = model.jnt_range[:24].T
            drawn = np.where(rng.random(24) < 0.5, low, high)
            data.qpos[:24] = np.where(rng.random(24) < 0.5, drawn, rng.uniform(low, high))
            mujoco.mj_kinematics(model, data)
            for geom in hand:
                rotation, size = data.geom_xmat[geom].reshape(3, 3)[2], model.geom_size[geom]
                box = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_BOX)
                reach = np.abs(rotation) @ size if box else size[0] + abs(rotation[2]) * size[1]
                assert data.geom_xpos[geom, 2] > reach

    def test_what_is_left_out_changes_nothing_in_the_hand(self, model, host):
        """The whole model of gymnasium-robotics against ours, in C, with the block held, turned and dropped."""
        whole = mujoco.MjModel.from_xml_path(str(hand_block.find_asset()))
        data, ours, rng = mujoco.MjData(whole), mujoco.MjData(model), np.random.default_rng(0)
        middle = model.actuator_ctrlrange.mean(axis=1)
        half_range = np.ptp(model.actuator_ctrlrange, axis=1) / 2
        for seed in range(3):
            mujoco.mj_resetData(whole, data)
            mujoco.mj_resetData(model, ours)
            state = host.reset(jax.random.key(seed)).physics
            ours.qpos[:], ours.qvel[:] = data.qpos[:31], data.qvel[:30] = state[1:32], state[32:62]
            for _ in range(10):
                data.ctrl[:] = ours.ctrl[:] = middle + half_range * rng.uniform(-1, 1, 20)
                mujoco.mj_step(whole, data, 20)
                mujoco.mj_step(model, ours, 20)
                np.testing.assert_allclose(ours.qpos, data.qpos[:31], rtol=0, atol=1e-6)

    def test_contacts(self, model):
        from mujoco.mjx._src import collision_driver

        # 19 of the hand with itself, one of them listed twice; 21 of the block: floor, forearm, 16 capsules, 3 boxes.
        assert len(list(collision_driver.geom_pairs(model))) == 19 + 21
        assert np.bincount(collision_driver.make_condim(model)).tolist() == [0, 16, 0, 0, 16]


@needs_hand
class TestEpisode:
    def test_auto_is_c_mujoco(self, host):
        assert (host.backend, host.compiled, host.view.cameras) == ("mujoco", False, ("palm", "side"))
        assert (host.coverage.num_cells, host.coverage.reachable) == (512, 256)
        with pytest.raises(ValueError, match=r"Did you mean 'mujoco'\?"):
            envs.make("hand_block", backend="mujco")

    def test_same_key_same_state(self, host):
        first, again, other = (host.reset(jax.random.key(seed)) for seed in (3, 3, 4))
        np.testing.assert_array_equal(first.physics, again.physics)
        assert not np.array_equal(first.physics, other.physics)

    def test_every_start_has_the_block_on_the_palm(self):
        qpos, qvel = hand_block.settled_starts()
        assert qpos.shape == (100, 31) and qvel.shape == (100, 30)
        # Above the palm, which is 4.7 cm below the fall, and at most 5 cm to either side.
        assert np.abs(qpos[:, 24:27] - [1.0, 0.87, 0.17]).max() < 0.05
        assert np.abs(qvel[:, 24:27]).max() < 0.3
        np.testing.assert_allclose(np.linalg.norm(qpos[:, 27:], axis=1), 1, atol=1e-9)
        assert len(np.unique(cells(qpos[:, 27:]))) > 50
        drawn = jax.jit(jax.vmap(hand_block.start))(jax.random.split(jax.random.key(0), 2_000))[0]
        assert len(np.unique(drawn[:, 24])) == 100

    def test_layout_and_time_limit(self, host):
        state, rng = host.reset(jax.random.key(0)), np.random.default_rng(0)
        for step in range(300):
            state, transition = host.step(state, rng.uniform(-1, 1, 20))
            assert (bool(transition.terminated), bool(transition.truncated)) == (False, step == 299)
            assert transition.reward == 0
        qpos, qvel = np.float32(state.physics[1:32]), np.float32(state.physics[32:62])
        obs = state.obs
        np.testing.assert_array_equal(obs[:24], qpos[:24])
        np.testing.assert_array_equal(obs[24:48], qvel[:24])
        np.testing.assert_array_equal(obs[48:54], qvel[24:])
        np.testing.assert_array_equal(obs[54:], qpos[24:])
        np.testing.assert_allclose(np.linalg.norm(obs[-4:]), 1, atol=1e-6)

    def test_servos_go_where_actions_say(self, host, model):
        # Without the block, which is put on the floor: fingers spread or bent to the ends and the middle of the range.
        joints = [model.joint(model.actuator(i).trnid[0]).qposadr[0] for i in range(20)]
        for action in (-1.0, 0.0, 1.0):
            state = host.reset(jax.random.key(0))
            state.physics[25:28] = 0.3, 0.3, 0.025
            for _ in range(25):
                state, _ = host.step(state, np.full(20, action))
            target = model.actuator_ctrlrange.mean(axis=1) + action * np.ptp(model.actuator_ctrlrange, axis=1) / 2
            error = np.abs(state.physics[1:][joints] - target)
            # The wrist gives way under the hand's weight; a bent fingertip may be stopped by the thumb.
            assert np.median(error) < 0.1 and error[model.actuator("robot0:A_THJ4").id] < 0.2

    def test_a_fallen_block_stays_fallen(self, host):
        state = host.reset(jax.random.key(0))
        state.physics[25:28], state.physics[28:32] = (0.7, 0.7, 0.1), (1, 0, 0, 0)
        for _ in range(25):
            state, transition = host.step(state, np.zeros(20))
        np.testing.assert_allclose(transition.next_obs[56], 0.025, atol=1e-3)
        assert not transition.terminated

    def test_bad_action(self, host):
        with pytest.raises(ValueError, match=r"action has shape \(8,\). Allowed: \(20,\)"):
            host.step(host.reset(jax.random.key(0)), np.zeros(8))


@needs_hand
@pytest.mark.slow
def test_mjx_block_rests_falls_and_turns_alike(host):
    """MJX beside C from the same states: on the palm, in the air, on the floor, and turned by the hand."""
    device = make_hand_block("mjx")
    rng = np.random.default_rng(0)
    states = [host.reset(jax.random.key(seed)) for seed in range(6)]
    states[4].physics[25:28] = 0.7, 0.7, 1.0  # Falls, turning.
    states[4].physics[59:62] = 1, 2, 3
    states[5].physics[25:32] = 0.7, 0.7, 0.0249, 1, 0, 0, 0  # Lies on the floor.
    states[5].physics[56:62] = 0
    on_device = jax.vmap(device.reset)(jax.random.split(jax.random.key(0), 6))
    physics = jnp.asarray(np.stack([state.physics for state in states]), jnp.float32)
    on_device = on_device.replace(physics=on_device.physics.replace(qpos=physics[:, 1:32], qvel=physics[:, 32:62]))
    first = np.stack([state.obs for state in states])
    step, differences = jax.jit(jax.vmap(device.step)), []
    for _ in range(10):
        actions = rng.uniform(-1, 1, (6, 20)).astype(np.float32) * np.array([[0], [0], [0.3], [0.3], [1], [1]])
        on_device, got = step(on_device, actions)
        pairs = [host.step(state, action) for state, action in zip(states, actions, strict=True)]
        states = [state for state, _ in pairs]
        differences.append(np.abs(jax.device_get(got.next_obs) - np.stack([want.next_obs for _, want in pairs])))
    angles, places = np.stack(differences)[..., :24], np.stack(differences)[..., 54:]
    last = np.stack([state.obs for state in states])
    # Bounds are a few times what was measured. In 10 steps the hand moves by 0.13 rad, and turns blocks 2 and 3 by 8
    # degrees, which changes an entry of their quaternions by up to 0.07; block 4 falls 0.8 m.
    assert np.abs(last - first)[:, :24].max(axis=1).min() > 0.1
    assert np.abs(np.sum(last[2:4, -4:] * first[2:4, -4:], axis=1)).max() < np.cos(np.deg2rad(5) / 2)
    assert last[4, 56] < 0.3
    assert places[:, 4:].max() < 2e-5
    assert places[0, :4].max() < 0.005 and places[:, :4].max() < 0.04
    assert places[:, :4, :3].max() < 0.003
    assert angles[0].max() < 0.002 and angles.max() < 0.02
