"""Comparisons with peers: the pairing, what is said where they are missing, and our side of each, without any peer."""

import dataclasses
import sys
import types

import jax
import numpy as np
import pytest

from benchmarks import flops, peers, run
from benchmarks.peers import common, ensemble, returns, sac, search, vector
from benchmarks.peers.common import Line
from benchmarks.timing import Pairs, measure_pairs
from experiments.analysis.peers import read as read_peer
from experiments.runs.presets import preset_config
from jaxplore import MCTSConfig, SACConfig, rewards
from jaxplore.behaviours.mcts import make_mcts

SMOKE = preset_config("smoke", method="max").explorer
TINY = dataclasses.replace(
    SMOKE,
    dynamics=dataclasses.replace(SMOKE.dynamics, hidden=(8, 8)),
    ensemble=dataclasses.replace(SMOKE.ensemble, num_members=3),
    fit=dataclasses.replace(SMOKE.fit, batch_size=4),
    imagination=dataclasses.replace(SMOKE.imagination, num_actors=5),
    sac=SACConfig(hidden=(8,), batch_size=4),
)


class Clock:
    """A clock that only work moves on."""

    def __init__(self):
        self.now, self.order = 0.0, []

    def __call__(self):
        return self.now

    def work(self, who, seconds):
        """A call that takes as many seconds as its turn says."""
        turns = iter(seconds)

        def call():
            self.order.append(who)
            self.now += next(turns)

        return call


def test_pairs_alternate_and_the_ratio_is_within_a_pair():
    clock = Clock()
    # Two calls to warm up, then five pairs; the machine is ten times slower in the middle of them.
    ours = clock.work("ours", [100, 50, 1, 1, 10, 10, 1])
    theirs = clock.work("theirs", [100, 50, 2, 3, 20, 40, 1])
    pairs = measure_pairs(ours, theirs, pairs=5, clock=clock)
    assert clock.order == ["ours", "theirs"] * 7
    assert pairs == Pairs(ours=1, theirs=3, ratio=2, low=2, high=3)


def test_times_are_per_unit_of_work():
    clock = Clock()
    ours, theirs = (clock.work(who, [seconds] * 99) for who, seconds in (("ours", 6.0), ("theirs", 3.0)))
    pairs = measure_pairs(ours, theirs, pairs=2, calls=3, inner=2, clock=clock)
    assert pairs == Pairs(ours=3.0, theirs=1.5, ratio=0.5, low=0.5, high=0.5)
    assert clock.order == ["ours", "theirs"] * 2 + [*["ours"] * 3, *["theirs"] * 3] * 2


def test_one_pair_has_no_spread():
    with pytest.raises(ValueError, match=r"pairs=1\. Allowed: at least 2"):
        measure_pairs(lambda: None, lambda: None, pairs=1)


@pytest.fixture
def without_extra(monkeypatch):
    """Nothing of the extra is installed, and nothing is measured."""
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: object() if name == "gymnasium" else None)
    monkeypatch.setattr(run, "matmul_rate", lambda: pytest.fail("measured"))


def test_without_a_peer_nothing_is_measured(without_extra, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run", "--only=peers"])
    assert run.main() == 2
    said = capsys.readouterr().err
    assert said.splitlines() == [
        "peers not installed: sbx-rl, stable-baselines3, torch, mctx. "
        'What to do: pip install -e ".[peers]".'
    ]  # fmt: skip


def test_those_that_are_there_are_measured(monkeypatch, tmp_path, capsys):
    line = Line("search", "tiny", "mctx", Pairs(1e-3, 2e-3, 2.0, 1.5, 2.5), 3 * 10**9)
    known = [peer._replace(lines=lambda: iter([line])) for peer in peers.PEERS if peer.package == "mctx"]
    monkeypatch.setattr(peers, "present", lambda: tuple(known))
    monkeypatch.setattr(peers, "PEERS", (*peers.PEERS[:1], *known))
    monkeypatch.setattr(peers, "peer_versions", lambda there: {peer.package: "1.0" for peer in there})
    monkeypatch.setattr(peers, "stay_on_one_core", lambda: [0])
    monkeypatch.setattr(run, "matmul_rate", lambda: 1e11)
    monkeypatch.setattr(sys, "argv", ["run", "--only=peers", f"--out={tmp_path / 'peers.json'}"])
    assert run.main() == 0
    said = capsys.readouterr()
    assert said.err.startswith("peers not installed: sbx-rl. What to do:")
    assert " ".join(said.out.splitlines()[4].split()) == "search tiny mctx 1 ms 2 ms 2.00 1.50 to 2.50 3 G -"
    stored = run.json.loads((tmp_path / "peers.json").read_text())
    assert stored["machine"]["versions"]["mctx"] == "1.0"
    assert stored["results"][0] == {
        **{"kernel": "search", "shape": "tiny", "who": "mctx", "our_flops": 3 * 10**9, "their_flops": None},
        **{"ours": 1e-3, "theirs": 2e-3, "ratio": 2.0, "low": 1.5, "high": 2.5},
    }


def test_without_only_peers_are_left_out(without_extra, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(run, "matmul_rate", lambda: 1e11)
    monkeypatch.setattr(run, "run_all", lambda rate, **_: iter(()))
    monkeypatch.setattr(sys, "argv", ["run", f"--out={tmp_path / 'all.json'}"])
    assert run.main() == 0
    assert "peers: left out; --only=peers" in capsys.readouterr().err


def all_finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree) if np.asarray(leaf).dtype.kind == "f")


def test_learning_alpha_keeps_the_shape():
    config = sac.learned(TINY.sac)
    assert (config.hidden, config.batch_size, config.learn_alpha, config.reward_scale) == ((8,), 4, True, 1.0)


@pytest.mark.parametrize("make", [sac.ours_drawing, sac.ours_given, lambda config: sac.ours_many(config, 3)])
def test_our_sac_goes_on_from_call_to_call(make):
    call = make(TINY.sac)
    (first, _), (second, _) = jax.device_get(call()), jax.device_get(call())
    assert all_finite((first, second))
    moved = jax.tree.map(lambda a, b: not np.array_equal(a, b), first.params["policy"], second.params["policy"])
    assert all(jax.tree.leaves(moved))


def test_our_ensemble_steps_and_imagines():
    call = ensemble.ours_step(TINY)
    first, second = (jax.device_get(call()[0].params) for _ in range(2))
    assert not any(jax.tree.leaves(jax.tree.map(np.array_equal, first, second)))
    imagined = ensemble.ours_imagined(TINY)()
    assert imagined.obs.shape == (ensemble.HORIZON, 5, 31) and all_finite(imagined)
    # Inputs of zeros, which all actors start from, tell the models nothing apart.
    assert (imagined.reward[1:] > 0).all()


def test_our_search_finds_what_is_near():
    tables = search.chain()
    assert tables.next_state.shape == (5, 40, 2)
    call = search.chained(make_mcts(2, MCTSConfig(horizon=5)).plan, tables, jax.numpy.int32(38))
    assert [int(call()[0]) for _ in range(3)] == [1, 1, 1]


def test_a_peer_that_is_always_there(monkeypatch):
    monkeypatch.setattr(vector, "HOST_STEPS", 2)
    cheetah, acrobot = vector.envs.make("half_cheetah_task", backend="mujoco"), vector.envs.make("acrobot")
    line = vector.line("cheetah", vector.ours_on_host(cheetah, 2, 2), "HalfCheetah-v5", 2, 2, "sync")
    assert (line.who, line.shape) == ("Gymnasium sync", "2 in parallel") and line.pairs.ratio > 0
    (one, _), last = vector.ours_on_host(cheetah, 2, 3)(), vector.ours_from_python(acrobot, 3, 2)()
    assert one.shape == (17,) and last.shape == (3, 6)


def test_flops_of_both_forms_of_sac_by_hand():
    # obs 1, action 1, one hidden layer of 1: a policy of 3 weights, action values of 3, a value network of 2.
    policy, q, v = 3 + 3 + 3, 9, 6  # forward, and twice backward
    pass_on = 2 * (2 * 3)  # through both action values, there and back
    assert flops.sac_update(1, 1, (1,), 1) == 2 * ((policy - 1) + (v - 1) + 2 + 2 * (q - 2) + pass_on)
    assert flops.sac_v2_update(1, 1, (1,), 1) == 2 * ((policy - 1) + 3 + 2 * (q - 2) + pass_on + 2 * 3)
    assert flops.ensemble_step((1, 1, 2), models=5, batch=1) == 5 * 2 * (3 * 3 - 1)


def test_the_ensemble_in_pytorch_computes_what_ours_does():
    torch = pytest.importorskip("torch")
    models, belief = ensemble.models_of(TINY), ensemble.belief_of(TINY)
    inputs = np.random.default_rng(0).normal(size=(7, 39)).astype(np.float32)
    ours = belief.predict(models, inputs)
    theirs = ensemble.predict(torch, ensemble.layers_of(torch, models), torch.from_numpy(inputs).expand(3, 7, 39))
    np.testing.assert_allclose(theirs[0], ours.mean, atol=1e-5)
    np.testing.assert_allclose(torch.exp(theirs[1]), ours.var, rtol=1e-5)
    reward = ensemble.divergence(torch, *theirs, TINY.renyi_decay)
    np.testing.assert_allclose(reward, rewards.jensen_renyi(ours, TINY.renyi_decay), atol=1e-4)
    step = ensemble.theirs_step(torch, TINY)
    assert step() != step()
    assert [leaf.shape[:2] for leaf in ensemble.theirs_imagined(torch, TINY)()] == [(ensemble.HORIZON, 5)] * 4


def test_mctx_searches_by_our_rules():
    mctx = pytest.importorskip("mctx")
    assert abs(search.agreement(mctx, MCTSConfig(), num=100)) < 4.0


@pytest.mark.parametrize("package", ["sbx", "stable_baselines3"])
def test_sac_of_peers_updates(package):
    pytest.importorskip(package)
    with jax.numpy_rank_promotion("allow"):
        model = sac.filled(package, TINY.sac)
        model.train(2, 4)
    assert model._n_updates == 2


def test_flops_of_the_second_form_against_what_xla_counts_of_sbx(monkeypatch):
    pytest.importorskip("sbx")
    config, programs = SACConfig(hidden=(256, 256), batch_size=256), []
    with jax.numpy_rank_promotion("allow"):
        model = sac.filled("sbx", config)
        update = type(model)._train

        def compile_only(*given):
            programs.append(update.lower(type(model), *given).compile())
            return *given[6:], None

        monkeypatch.setattr(model, "_train", compile_only)
        sac.sbx_given(model)()
    analysis = programs[0].cost_analysis()
    counted = (analysis[0] if isinstance(analysis, list) else analysis)["flops"]
    # XLA also counts biases, activations and Adam.
    assert counted == pytest.approx(flops.sac_v2_update(31, 8, config.hidden, 256), rel=0.05)


def test_the_table_of_peers():
    text = common.table([Line("step", "tiny", "PyTorch", Pairs(1.0, 0.5, 0.5, 0.45, 12.4), 2 * 10**9, 10**9)])
    assert " ".join(text.splitlines()[2].split()) == "step tiny PyTorch 1 s 500 ms 0.50 0.45 to 12 2 G 1 G"


class Constant:
    """A library's SAC that learns nothing and always does the same."""

    def __init__(self, policy, env, **settings):
        self.action, self.settings, self.num_timesteps = np.zeros(env.action_space.shape, np.float32), settings, 0

    def learn(self, steps, reset_num_timesteps):
        assert not reset_num_timesteps
        self.num_timesteps += steps

    def predict(self, obs, deterministic):
        assert deterministic
        return self.action, None


def test_a_whole_run_of_a_peer_is_evaluated_as_ours_are(monkeypatch, tmp_path):
    package = types.SimpleNamespace(SAC=Constant, __version__="1.0")
    monkeypatch.setitem(sys.modules, "sbx", package)
    monkeypatch.setattr(returns, "torch_on_one_thread", lambda: None)
    out = tmp_path / "run.json"
    flags = ["--steps=25", "--eval-every=10", "--eval-episodes=2", "--warm-up-steps=7", f"--out={out}"]
    monkeypatch.setattr(sys, "argv", ["returns", "--library=sbx", *flags])
    assert returns.main() == 0
    stored = run.json.loads(out.read_text())
    assert [row["env_steps"] for row in stored["rows"]] == [10, 20, 25] and stored["warm_up_steps"] == 7
    # A cheetah that does nothing stays where it is, but for how it lands.
    assert all(abs(row["return"]) < 50 for row in stored["rows"])
    assert stored["rows"][0]["return_std"] > 0
    # and is read back to stand beside ours
    peer = read_peer(out)
    assert (peer.library, peer.version, peer.seed, peer.steps) == ("sbx", "1.0", 0, (10, 20, 25))
    assert list(peer.returns) == [row["return"] for row in stored["rows"]]


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--eval-every=0", "--eval-every=0. Allowed: a whole number, 1 or more."),
        ("--out=nowhere/run.json", "--out=nowhere/run.json. Allowed: a file in a directory that is there."),
        ("--seed=1", "--library=sbx: sbx is not installed. What to do: "),
    ],
)
def test_a_run_of_a_peer_that_cannot_be_is_refused_in_a_line(flag, message, monkeypatch, tmp_path, capsys):
    def missing(*_):
        raise ModuleNotFoundError("No module named 'sbx'", name="sbx")

    monkeypatch.setattr(returns, "train", missing)
    monkeypatch.setattr(sys, "argv", ["returns", "--library=sbx", f"--out={tmp_path / 'run.json'}", flag])
    with pytest.raises(SystemExit, match="2"):
        returns.main()
    assert message in capsys.readouterr().err and list(tmp_path.iterdir()) == []
